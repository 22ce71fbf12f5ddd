"""``pebble web`` and the management of the people who may log in."""
