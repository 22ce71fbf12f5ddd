"""``pebble web``, and the people who may log in there."""
