"""Putting MicroPython and a robot's firmware onto its board: what ``pebble flash`` does. docs/firmware.md tells how."""
