"""A transport for MQTT by the package paho-mqtt, found by its entry point."""

from pebble.extension import Extension

EXTENSION = Extension(name="paho", extra="paho", packages=("paho",), page="docs/transports.md")
