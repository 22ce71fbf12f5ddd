"""A world in which simulated robots drive, stop at walls and at each other, and have cameras."""
