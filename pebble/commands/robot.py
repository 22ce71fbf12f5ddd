"""What ``pebble up`` does. Imports nothing that a running robot does not need: this process stays."""

from __future__ import annotations

from pathlib import Path

from pebble.config import load
from pebble.launcher.launcher import Launcher


def run(path: Path) -> int:
    """Run the robot that the config at ``path`` describes; returns the exit code. Raises PebbleError."""
    return Launcher(load(path)).run()
