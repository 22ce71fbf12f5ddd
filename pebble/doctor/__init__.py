"""What may be wrong with a robot's machine, and what to type about it."""
