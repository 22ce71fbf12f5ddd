"""Sends sound to operators, in the encoding they request and never old, over a connection of its own."""

from pebble.extension import Extension

EXTENSION = Extension(
    name="audio_publisher",
    needs=("av_daemon",),
    programs="pebble.services.av_daemon.offers:microphone_programs",
    page="docs/ext/media.md",
)
