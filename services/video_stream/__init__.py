"""Runs a foreign streaming program while video is requested."""
