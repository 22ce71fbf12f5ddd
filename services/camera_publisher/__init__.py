"""Sends pictures to operators: at the configured rate, never old ones, over a connection of its own."""
