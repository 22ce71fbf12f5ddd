"""Checks of a machine, a broker, a running robot, and a robot's conformance to the contract."""

from pebble.extension import Command, Extension

EXTENSION = Extension(
    name="checks",
    needs=("operator", "fleet", "page"),
    commands={
        "doctor": Command(
            "pebble.extensions.checks.commands.doctor:doctor",
            "find what is wrong with a machine, robot or broker",
            "own",
            40,
        ),
        "conform": Command(
            "pebble.extensions.checks.commands.conform:conform",
            "judge a robot of your own by the contract",
            "write",
            40,
        ),
    },
    former={"selftest": "doctor --running", "report": "doctor --report FILE.zip"},
    page="docs/life-of-a-robot.md",
)
