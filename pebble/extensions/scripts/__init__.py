"""Scripts that drive a robot: their base class, the shipped ones, and perception."""

from pebble.extension import Command, Extension

EXTENSION = Extension(
    name="scripts",
    needs=("operator",),
    extra="scripts",
    commands={
        "script": Command(
            "pebble.extensions.scripts.commands.group", "write, start and stop programs that move a robot", "write", 10
        ),
    },
    former={"script status": "script list"},
    page="docs/ext/scripts.md",
)
