"""Rules between the keys of a config, and warnings."""
