"""The link to a robot's microcontrollers: one process per serial port, one file per line protocol."""
