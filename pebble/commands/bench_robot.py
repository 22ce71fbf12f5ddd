"""``pebble bench startup`` and ``pebble bench cost``: whole robots, both transports side by side."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pebble.bench.output import FOLDER

_Variants = Annotated[
    str | None, typer.Option(help="mqtt or zenoh. [default: both, in turn]", metavar="NAMES", show_default=False)
]
_Quick = Annotated[bool, typer.Option("--quick", help="Fewer and shorter rounds, marked as quick.")]
_Output = Annotated[Path, typer.Option(help="Where results and plots go.", metavar="FOLDER")]


def startup(
    rounds: Annotated[
        int | None, typer.Option(min=1, help="Launches of each. [default: 10, quick 3]", show_default=False)
    ] = None,
    variants: _Variants = None,
    quick: _Quick = False,
    output: _Output = FOLDER,
) -> int:
    """How soon a robot is there: heartbeat, all services ready, first drive command obeyed.

    And how soon an operator, or a service, who comes late knows all that the robot keeps. Every launch is a whole
    simulated robot of its own; needs mosquitto.

    \b
        pebble bench startup
        pebble bench startup --quick
    """
    from pebble.bench.startup import Plan, run

    return run(Plan(rounds=rounds, kinds=_kinds(variants), quick=quick, output=output))


def cost(
    rounds: Annotated[
        int | None, typer.Option(min=1, help="Robots of each. [default: 8, quick 1]", show_default=False)
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(min=0.5, help="Length of each phase. [default: 1.5, quick 0.7]", show_default=False)
    ] = None,
    variants: _Variants = None,
    quick: _Quick = False,
    output: _Output = FOLDER,
) -> int:
    """What a robot costs: memory, CPU and threads of each of its processes.

    Idle, driven 20 times a second, and sending pictures (640x480, 15 per second) and sound to an operator in two
    forms. Whole simulated robots; needs mosquitto.

    \b
        pebble bench cost
        pebble bench cost --variants zenoh --seconds 10
    """
    from pebble.bench.cost import Plan, run

    return run(Plan(rounds=rounds, seconds=seconds, kinds=_kinds(variants), quick=quick, output=output))


def _kinds(variants: str | None) -> list[str]:
    from pebble.bench.bridge_robot import KINDS

    return list(KINDS) if variants is None else [name.strip() for name in variants.split(",")]


def register(group: typer.Typer) -> None:
    """Add the commands of this file."""
    for command in (startup, cost):
        group.command(command.__name__)(command)
