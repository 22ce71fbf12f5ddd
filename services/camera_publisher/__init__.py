"""The sender of pictures to operators: at the configured rate, never old ones, over a connection of its own."""

from pebble.extension import Extension

EXTENSION = Extension(
    name="camera_publisher",
    needs=("av_daemon",),
    extra="media",
    packages=("cv2",),
    programs="pebble.services.av_daemon.offers:camera_programs",
    page="docs/ext/media.md",
)
