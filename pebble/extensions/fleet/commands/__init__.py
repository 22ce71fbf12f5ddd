"""``pebble fleet``: commands for more than one robot."""
