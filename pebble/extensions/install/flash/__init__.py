"""``pebble flash``: installs MicroPython and a robot's firmware on its board. Described in docs/firmware.md."""
