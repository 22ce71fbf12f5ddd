"""Sound towards operators: packed as they asked for, never old, over a connection of its own."""
