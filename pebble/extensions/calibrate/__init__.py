"""Calibration of a robot: its wheels by straight runs and spins, its camera by pictures of a tag."""

from pebble.extension import Command, Extension

EXTENSION = Extension(
    name="calibrate",
    needs=("scripts",),
    extra="calibrate",
    commands={
        "calibrate": Command(
            "pebble.extensions.calibrate.commands", "measure a robot's wheels, or its camera", "own", 55
        ),
    },
    page="docs/ext/calibrate.md",
)
