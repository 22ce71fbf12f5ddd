"""Simulated MicroPython boards, which run the real firmware files on simulated pins."""
