"""Operators: the client library, and the commands that use it."""

from pebble.extension import Command, Extension

_COMPLETION = "pebble.extensions.operator.commands.completion"

EXTENSION = Extension(
    name="operator",
    needs=("media",),
    commands={
        "estop": Command(
            "pebble.extensions.operator.commands.estop:estop", "stop robots until they are reset", "use", 30
        ),
        "watch": Command(
            "pebble.extensions.operator.commands.watch:watch",
            "write a picture of a robot's camera into a file",
            "use",
            40,
        ),
        "topic": Command(
            "pebble.extensions.operator.commands.topic", "list, print, publish and measure messages", "write", 20
        ),
    },
    former={"topics": "topic contract", "topic bw": "topic hz", "snapshot": "watch --picture FILE"},
    completions={
        "CONFIG": f"{_COMPLETION}:configs",
        "CONFIG…": f"{_COMPLETION}:configs",
        "ROBOT": f"{_COMPLETION}:robots",
        "[SYSTEM/TYPE/]ID": f"{_COMPLETION}:robots",
        "[reset|status] ROBOT": f"{_COMPLETION}:stops",
    },
    page="docs/topics.md",
)
