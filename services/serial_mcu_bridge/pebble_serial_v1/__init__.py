"""The protocol of MCUs that describe themselves, `pebble_serial_v1`. Pure: bytes in, bytes out."""

from pebble.extension import Extension

EXTENSION = Extension(name="pebble_serial_v1", page="docs/ext/serial-protocol.md")
