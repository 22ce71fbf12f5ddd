"""``pebble recordings``, and other commands for recordings."""
