"""The way of a command to the motors: inbox, latch, arbiter and lease, and the file that keeps the stop."""
