"""The one place that says which Pebble this is."""

__version__ = "0.1.0"
