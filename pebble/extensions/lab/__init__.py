"""Simulated robots, the demo, comparisons, and the rig that starts them."""
