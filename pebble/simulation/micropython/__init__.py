"""MicroPython boards on this machine: they run the real firmware files against simulated pins."""
