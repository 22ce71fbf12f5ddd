"""``pebble recordings`` and what else works on recordings."""
