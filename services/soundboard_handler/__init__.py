"""The player of sound clips: one at a time, by the robot's player program."""

from pebble.extension import Extension, Program

_MODULE = "pebble.services.soundboard_handler"

EXTENSION = Extension(
    name="soundboard_handler",
    needs=("media",),
    sections={"services.soundboard_handler": f"{_MODULE}.config:SoundboardHandler"},
    program=Program("soundboard_handler", f"{_MODULE}.service:SoundboardHandler"),
    offers=f"{_MODULE}.config:offers",
    page="docs/ext/soundboard.md",
)
