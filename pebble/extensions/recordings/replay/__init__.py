"""Replay: a recording, published again."""
