"""``pebble up`` with options, and its help; ``pebble.cli`` runs a plain ``pebble up CONFIG`` without this module."""

from pathlib import Path
from typing import Annotated

import typer

ConfigArgument = Annotated[Path, typer.Argument(help="A robot's config file.", metavar="CONFIG", show_default=False)]


def up(
    config: ConfigArgument,
    core_only: Annotated[
        bool, typer.Option("--core-only", help="Without extensions: no page, camera, sounds or scripts.")
    ] = False,
) -> int:
    """Run the robot that CONFIG describes, until Ctrl-C or SIGTERM.

    Starts every enabled service (on Zenoh robots the hub first), and restarts processes that end unexpectedly.

    \b
        pebble up configs/goob.json
    """
    from pebble.config import load
    from pebble.launcher.launcher import Launcher

    return Launcher(load(config, lenient=True, core_only=core_only)).run()
