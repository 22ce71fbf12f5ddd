"""MicroPython's built-in modules, on simulated pins, sockets and time."""
