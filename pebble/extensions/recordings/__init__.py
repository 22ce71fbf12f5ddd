"""Recordings: what robots and operators published, in MCAP files."""
