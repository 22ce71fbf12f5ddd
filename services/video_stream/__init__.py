"""The runner of a third party's streaming program, while video is requested."""

from pebble.extension import Extension

EXTENSION = Extension(
    name="video_stream",
    needs=("media",),
    sections={"services.video_stream": "pebble.services.video_stream.config:VideoStream"},
    rules="pebble.services.video_stream.config:RULES",
    programs="pebble.services.video_stream.config:programs",
    offers="pebble.services.video_stream.config:offers",
    page="docs/ext/media.md",
)
