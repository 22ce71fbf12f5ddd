"""Forwarding between a robot's own transport and another one: shared by the bridge and the mirror."""
