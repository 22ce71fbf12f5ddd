"""The player of an operator's voice on the robot: a jitter buffer, and a program for the loudspeaker."""

from pebble.extension import Extension

EXTENSION = Extension(
    name="audio_receiver",
    needs=("av_daemon",),
    programs="pebble.services.av_daemon.offers:loudspeaker_programs",
    page="docs/ext/media.md",
)
