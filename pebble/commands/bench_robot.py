"""``pebble bench bridge``: whole robots."""

from __future__ import annotations

from typing import Annotated

import typer

from pebble.bench.comparison import FOLDER
from pebble.commands.options import Output, Quick, split_names


def bridge(
    with_media: Annotated[
        bool, typer.Option("--with-media", help="Also with 1080p pictures and sound, and compare.")
    ] = False,
    rounds: Annotated[
        int | None, typer.Option(min=1, help="How often robots are started. [default: 10; --quick: 4]")
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(min=0.1, help="Driving time per robot and round. [default: 4; --quick: 0.5]")
    ] = None,
    variants: Annotated[
        str | None,
        typer.Option(help="mqtt, zenoh or mqtt,zenoh. [default: both; --null: zenoh]", metavar="NAMES"),
    ] = None,
    quick: Quick = False,
    null: Annotated[
        bool, typer.Option("--null", help="One robot against itself, and against itself slowed down by a fifth.")
    ] = False,
    profile: Annotated[bool, typer.Option("--profile", help="Latency of a command hop by hop.")] = False,
    output: Output = FOLDER,
) -> int:
    """Drive commands from an operator to the wheels of a whole simulated robot, and its telemetry back.

    Latency at 20 commands and 50 reports a second, on MQTT and on Zenoh, compared with one hop through a stock
    broker. With --with-media also while a program on the robot reads 1920x1080 frames at 30 Hz and an operator
    receives video and audio. Needs mosquitto.

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
        "kinds": None if variants is None else split_names(variants),
    }
    given = {name: value for name, value in given.items() if value is not None}
    wanted = plan(mode, quick=quick, output=output, **given)
    return {Mode.NULL: bridge_null.run, Mode.PROFILE: bridge_profile.run}.get(mode, run)(wanted)


COMMANDS = (bridge,)
