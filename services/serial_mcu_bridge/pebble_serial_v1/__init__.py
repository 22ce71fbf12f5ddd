"""The protocol of MCUs that describe themselves, `pebble_serial_v1`. Pure: bytes in, bytes out."""
