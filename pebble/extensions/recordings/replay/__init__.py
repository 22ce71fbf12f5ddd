"""Replay: publishes a recording again."""
