"""Pictures and sound on the wire: encoders, decoders, a jitter buffer, and computed test material."""

from pebble.extension import Extension

EXTENSION = Extension(name="media", extra="media", page="docs/ext/media.md")
