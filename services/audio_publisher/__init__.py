"""Sends sound to operators, in the encoding they request and never old, over a connection of its own."""
