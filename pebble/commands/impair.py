"""``pebble impair``: robots behind an impaired network."""

from __future__ import annotations

from typing import Annotated

import typer

from pebble.bench.output import FOLDER
from pebble.commands.options import Output, split_names


def impair(
    trials: Annotated[
        str | None, typer.Option(help="Some of them, separated by commas. [default: all 16]", metavar="NAMES")
    ] = None,
    subjects: Annotated[
        str | None,
        typer.Option(help='Such as "mqtt original,zenoh h264 opus". [default: all four]', metavar="NAMES"),
    ] = None,
    both_ways: Annotated[bool, typer.Option("--both-ways", help="Impair the direction to the robot, too.")] = False,
    link: Annotated[str, typer.Option(help="auto, namespaces (needs root) or proxy.", metavar="KIND")] = "auto",
    window: Annotated[
        float | None, typer.Option(help="Seconds of video, and of audio, per trial. [default: 8; quick: 4]")
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Four trials, short windows, all robots at the same time.")
    ] = False,
    output: Output = FOLDER,
) -> int:
    """Robots behind an impaired network: the trials of the paper's section 4.2.

    Simulated robots on MQTT and on Zenoh, with the original's encodings and with H.264 and Opus, each with its own
    network to its broker. In each trial the network has a low rate, loses packets, or both; an operator drives the
    robot and receives its video and audio. Needs mosquitto; without root, a proxy replaces network namespaces.

    \b
        pebble impair --quick
        pebble impair --trials base-start,256k,64k+5%
        pebble impair --link proxy --subjects "mqtt h264 opus"
    """
    from pebble.bench.impair.plan import NAMES, ImpairPlan
    from pebble.bench.impair.run import run

    return run(
        ImpairPlan(
            trials=() if trials is None else split_names(trials),
            subjects=NAMES if subjects is None else split_names(subjects),
            both_ways=both_ways,
            network=link,
            window_s=window,
            quick=quick,
            output=output,
        )
    )


def register(app: typer.Typer) -> None:
    app.command("impair")(impair)
