"""Somebody else's streaming program, run while operators want video."""
