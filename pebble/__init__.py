"""Pebble: one contract for very different robots, over MQTT or Zenoh."""

from pebble.version import __version__ as __version__
