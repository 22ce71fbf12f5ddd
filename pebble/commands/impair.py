"""``pebble impair``: a robot behind a bad link."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pebble.bench.output import FOLDER


def impair(
    trials: Annotated[
        str | None, typer.Option(help="Some of them, separated by commas. [default: all 16]", metavar="NAMES")
    ] = None,
    subjects: Annotated[
        str | None,
        typer.Option(help='Such as "mqtt original,zenoh h264 opus". [default: all four]', metavar="NAMES"),
    ] = None,
    both_ways: Annotated[bool, typer.Option("--both-ways", help="Impair the way to the robot, too.")] = False,
    link: Annotated[str, typer.Option(help="auto, namespaces (needs root) or proxy.", metavar="KIND")] = "auto",
    window: Annotated[
        float | None, typer.Option(help="Seconds of video, and of audio, per trial. [default: 8; quick: 4]")
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Four trials, short windows, all robots at the same time.")
    ] = False,
    output: Annotated[Path, typer.Option(help="Where the results go.", metavar="FOLDER")] = FOLDER,
) -> int:
    """A robot behind a bad link: the impairment trials of the paper, chapter 4.2.

    Simulated robots on MQTT and on Zenoh, with the original's encodings and with H.264 and Opus, each behind a link of
    its own to its broker. In each trial the link gets slow, loses packets, or both; the robot is driven, watched and
    listened to. Needs mosquitto; without root, a proxy stands in for the link.

    \b
        pebble impair --quick
        pebble impair --trials base-start,256k,64k+5%
        pebble impair --link proxy --subjects "mqtt h264 opus"
    """
    from pebble.impair.plan import NAMES, Plan
    from pebble.impair.run import run

    return run(
        Plan(
            trials=_names(trials) or (),
            subjects=_names(subjects) if subjects is not None else NAMES,
            both_ways=both_ways,
            link=link,
            window_s=window,
            quick=quick,
            output=output,
        )
    )


def register(app: typer.Typer) -> None:
    app.command("impair")(impair)


def _names(text: str | None) -> list[str]:
    return [name.strip() for name in (text or "").split(",") if name.strip()]
