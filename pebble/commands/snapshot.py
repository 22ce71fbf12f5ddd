"""``pebble snapshot``: one picture of a robot's camera, into a file."""

from __future__ import annotations

import typer

from pebble.commands.watch import snapshot


def register(app: typer.Typer) -> None:
    app.command("snapshot")(snapshot)
