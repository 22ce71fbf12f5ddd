"""Simulated robots, the demo, the comparisons of ``pebble bench``, and the rig, which starts their processes."""

from pebble.extension import Command, Extension

EXTENSION = Extension(
    name="lab",
    needs=("operator", "media", "scripts", "fleet", "recordings", "page"),
    commands={
        "demo": Command(
            "pebble.extensions.lab.commands.sim", "run four simulated robots; needs nothing else", "use", 10
        ),
        "sim": Command("pebble.extensions.lab.commands.sim", "simulate boards, robots, rooms and fleets", "write", 30),
        "bench": Command(
            "pebble.extensions.lab.commands.bench", "compare MQTT and Zenoh on this machine", "measure", 50
        ),
    },
    former={"impair": "bench impair"},
    page="docs/ext/simulated-world.md",
)
