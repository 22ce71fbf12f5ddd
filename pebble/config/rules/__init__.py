"""What a config must keep to beyond the limits of each key, and what it is warned of."""
