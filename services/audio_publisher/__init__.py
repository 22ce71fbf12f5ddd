"""The sender of sound to operators: in the encoding that they request, never late, on its own connection."""

from pebble.extension import Extension

EXTENSION = Extension(
    name="audio_publisher",
    needs=("av_daemon",),
    programs="pebble.services.av_daemon.offers:microphone_programs",
    page="docs/ext/media.md",
)
