"""Runs autonomy scripts, at most one at a time."""
