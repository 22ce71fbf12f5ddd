"""``pebble sim``: a simulated MCU in the foreground, where a serial port is expected."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer


class Board(StrEnum):
    GOOB = "goob"
    FRED = "fred"


def sim(
    board: Annotated[Board, typer.Argument(help="Whose motor MCU.", show_default=False)],
    link: Annotated[
        Path | None,
        typer.Option(help="Where the serial port shall appear. [default: /tmp/pebble-BOARD]", metavar="PATH"),
    ] = None,
    charging: Annotated[bool, typer.Option("--charging", help="Start on the charger.")] = False,
) -> int:
    """A simulated motor MCU on a pseudo terminal, until Ctrl-C.

    Write the path of its link into serial.port of the robot's config.

    \b
        pebble sim goob --link /tmp/goob
    """
    from pebble.simulation.mcu import main

    path = _default_link(board) if link is None else link
    typer.echo(f"{board} answers at {path}; Ctrl-C ends it")
    return main(["--kind", board.value, "--link", str(path), *(["--charging"] if charging else [])])


def _default_link(board: Board) -> Path:
    import tempfile

    return Path(tempfile.gettempdir(), f"pebble-{board}")


def register(app: typer.Typer) -> None:
    app.command("sim")(sim)
