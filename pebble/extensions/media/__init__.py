"""Pictures and sound on the wire: encoders, decoders, a jitter buffer, and computed test material."""

from pebble.extension import Extension

EXTENSION = Extension(
    name="media",
    extra="media",
    sections={"services.mqtt_bridge.media": "pebble.extensions.media.config:Media"},
    offers="pebble.extensions.media.offers:offers",
    page="docs/ext/media.md",
)
