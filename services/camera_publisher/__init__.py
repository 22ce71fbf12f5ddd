"""Pictures towards operators: as many per second as configured, never old ones, over a connection of their own."""
