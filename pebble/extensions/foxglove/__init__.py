"""A live view of robots in the Foxglove app."""

from pebble.extension import Command, Extension

EXTENSION = Extension(
    name="foxglove",
    needs=("operator", "media", "recordings"),
    extra="foxglove",
    commands={
        "foxglove": Command(
            "pebble.extensions.foxglove.command:foxglove", "show robots live in the Foxglove app", "use", 60
        ),
    },
    page="docs/ext/foxglove.md",
)
