"""Whole robots that drive by themselves in a simulated world: what is measured, and what is demanded."""
