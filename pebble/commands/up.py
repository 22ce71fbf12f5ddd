"""``pebble up`` for those who ask for its help; ``pebble.cli`` goes straight to the robot."""

from __future__ import annotations

import typer

from pebble.commands.options import ConfigArgument


def up(config: ConfigArgument) -> int:
    """Run the robot that CONFIG describes, until Ctrl-C or SIGTERM.

    Starts every enabled service (first the hub, where the robot uses Zenoh) and restarts what falls over.

    \b
        pebble up configs/goob.json
    """
    from pebble.commands.robot import run

    return run(config)


def register(app: typer.Typer) -> None:
    app.command("up")(up)
