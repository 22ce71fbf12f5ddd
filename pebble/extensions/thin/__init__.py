"""A bridge over a thin link: it measures what the link carries, sends no more than that, and tells operators."""

from pebble.extension import Extension

EXTENSION = Extension(
    name="thin", needs=("media",), uplink="pebble.extensions.thin.uplink:ThinUplink", page="docs/thin-links.md"
)
