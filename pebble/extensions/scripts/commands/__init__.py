"""``pebble script``, and the program that a new script begins with."""
