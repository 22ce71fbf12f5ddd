"""The set-up of a machine: packages, config, boards, backups, and signed releases."""

from pebble.extension import Command, Extension

EXTENSION = Extension(
    name="install",
    needs=("operator", "fleet", "page", "checks", "lab", "pebble_serial_v1"),
    commands={
        "setup": Command(
            "pebble.extensions.install.commands.setup:setup", "make a robot of this machine, or back it up", "own", 10
        ),
        "flash": Command(
            "pebble.extensions.install.commands.flash:flash", "install a robot's firmware on its board", "own", 50
        ),
    },
    facts="pebble.extensions.install.container:facts",
    former={"backup": "setup --backup FILE"},
    page="docs/life-of-a-robot.md",
)
