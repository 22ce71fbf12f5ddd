"""Carrying messages between a robot's own transport and another one: what the bridge and the mirror share."""
