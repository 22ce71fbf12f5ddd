"""``pebble bench bridge``: a whole robot between an operator and its MCU."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pebble.bench.output import FOLDER


def register(group: typer.Typer) -> None:
    """Add the commands of this file."""
    group.command("bridge")(bridge)


def bridge(
    with_media: Annotated[
        bool, typer.Option("--with-media", help="Also while 1080p pictures and sound flow, and compare.")
    ] = False,
    rounds: Annotated[
        int | None, typer.Option(min=1, help="Fresh robots so many times. [default: 10; --quick: 4]")
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(min=0.1, help="How long each is driven in each round. [default: 4; --quick: 0.5]")
    ] = None,
    variants: Annotated[
        str | None,
        typer.Option(help="mqtt or zenoh, or both with a comma. [default: both; --null: zenoh]", metavar="NAMES"),
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="A few short rounds; the results are marked.")] = False,
    null: Annotated[
        bool, typer.Option("--null", help="One robot against itself, and against itself made a fifth slower.")
    ] = False,
    profile: Annotated[
        bool, typer.Option("--profile", help="Where on its way a command spends its time, hop by hop.")
    ] = False,
    output: Annotated[Path, typer.Option(help="Where results and plots go.", metavar="FOLDER")] = FOLDER,
) -> int:
    """Drive commands from an operator to the wheels of a whole simulated robot, and its reports back.

    Latency at 20 commands and 50 reports a second, on MQTT and on Zenoh, side by side; beside it one hop through a
    stock broker. With --with-media also while the robot's camera gives 1920x1080 at 30 Hz to a program on it, and
    video and audio go to an operator. Needs mosquitto.

    \b
        pebble bench bridge
        pebble bench bridge --with-media --output results
        pebble bench bridge --profile
    """
    from pebble.bench import bridge_null, bridge_profile
    from pebble.bench.bridge import run
    from pebble.bench.bridge_plan import Mode, plan
    from pebble.errors import PebbleError

    modes = [mode for mode, wanted in ((Mode.MEDIA, with_media), (Mode.NULL, null), (Mode.PROFILE, profile)) if wanted]
    if len(modes) > 1:
        raise PebbleError(f"{' and '.join(modes)} are different runs: give one of them")
    mode = modes[0] if modes else Mode.COMPARE
    given = {
        "rounds": rounds,
        "seconds": seconds,
        "kinds": None if variants is None else [name.strip() for name in variants.split(",")],
    }
    given = {name: value for name, value in given.items() if value is not None}
    wanted = plan(mode, quick=quick, output=output, **given)
    return {Mode.NULL: bridge_null.run, Mode.PROFILE: bridge_profile.run}.get(mode, run)(wanted)
