"""Sound for operators: sent in the encoding that they request, never late, over a connection of its own."""

from pebble.extension import Extension

EXTENSION = Extension(
    name="audio_publisher",
    needs=("av_daemon",),
    programs="pebble.services.av_daemon.offers:microphone_programs",
    page="docs/ext/media.md",
)
