"""``pebble bench``: comparisons, side by side in one run on this machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pebble.bench.output import FOLDER
from pebble.commands import bench_bridge, bench_compare, bench_control, bench_report, bench_robot
from pebble.errors import PebbleError

_GROUP_HELP = """Comparisons, side by side in one run on this machine.

\b
    pebble bench frames
    pebble bench fleet --robots 200
"""
_Output = Annotated[Path, typer.Option("--output", help="Where results and plots go.", metavar="FOLDER")]
_Quick = Annotated[bool, typer.Option("--quick", help="Few cases and rounds; marked as quick.")]


def frames(
    seconds: Annotated[float | None, typer.Option(min=0.1, help="Of each case in a round. [default: 0.5]")] = None,
    rounds: Annotated[int | None, typer.Option(min=2, help="Of everything, in turn. [default: 8]")] = None,
    size: Annotated[
        list[str] | None, typer.Option(help="640x480; may be given several times. [default: 640x480, 1920x1080]")
    ] = None,
    readers: Annotated[
        list[int] | None, typer.Option(min=1, max=16, help="May be given several times. [default: 1, 3]")
    ] = None,
    variants: Annotated[
        str | None, typer.Option(help="Some of them, separated by commas. [default: all]", metavar="NAMES")
    ] = None,
    null: Annotated[
        str | None,
        typer.Option(help="Only this one, against itself and against itself made a fifth slower.", metavar="VARIANT"),
    ] = None,
    quick: _Quick = False,
    output: _Output = FOLDER,
) -> int:
    """Camera frames from one process to others: latency, CPU and memory.

    BGR pictures at 30 Hz through Zenoh shared memory (without copies, and with), Zenoh without shared memory, MQTT
    through mosquitto, GStreamer's shared memory, and beside them a bare copy. All variants in turn, round after round.

    With --null: one variant, one size (640x480), one reader, 30 rounds of 0.4 s. The verdict says whether the
    comparison sees a difference where there is none, or misses the one that was planted.

    \b
        pebble bench frames
        pebble bench frames --size 640x480 --readers 1 --variants zenoh-shm,gstreamer-shm
        pebble bench frames --null zenoh-shm
    """
    from pebble.bench import frames as comparison
    from pebble.bench import frames_null

    if null is not None and variants is not None:
        raise PebbleError("--null names its variant itself: leave --variants out")
    chosen = variants if null is None else null
    names = None if chosen is None else [name.strip() for name in chosen.split(",")]
    given = {"seconds": seconds, "rounds": rounds, "sizes": size, "readers": readers, "variants": names}
    run, plan = (comparison.run, comparison.plan) if null is None else (frames_null.run, frames_null.plan)
    return run(plan(quick=quick, output=output, **{name: value for name, value in given.items() if value}))


def video(
    seconds: Annotated[float | None, typer.Option(min=1, help="Length of the film. [default: 10]")] = None,
    quick: _Quick = False,
    output: _Output = FOLDER,
) -> int:
    """Video on the wire: bytes of every form at equal quality, on the same film."""
    from pebble.bench.video import run

    return run(output, seconds, quick=quick)


def sound(output: _Output = FOLDER) -> int:
    """Sound on the wire: bytes of every form, with all headers."""
    from pebble.bench.sound import run

    return run(output)


def fleet(
    robots: Annotated[int | None, typer.Option(min=1, help="How many robots with Wi-Fi. [default: 200]")] = None,
    seconds: Annotated[float | None, typer.Option(min=1, help="How long they are driven. [default: 60]")] = None,
    rate: Annotated[float, typer.Option(min=0.1, help="Commands a second to each of them.")] = 10.0,
    quick: _Quick = False,
    output: _Output = FOLDER,
) -> int:
    """MCU robots by the hundred on one broker: hearts, command latency, cost.

    The real firmware files on simulated pins, real TCP; one operator drives all of them. Needs mosquitto.

    \b
        pebble bench fleet
        pebble bench fleet --robots 20 --seconds 10
    """
    from pebble.bench.fleet import plan, run

    given = {name: value for name, value in {"robots": robots, "seconds": seconds}.items() if value}
    return run(plan(quick=quick, rate_hz=rate, output=output, **given))


def register(app: typer.Typer) -> None:
    group = typer.Typer(help=_GROUP_HELP, rich_markup_mode=None)
    for command in (frames, fleet, video, sound):
        group.command(command.__name__)(command)
    for more in (bench_control, bench_bridge, bench_robot, bench_compare, bench_report):
        more.register(group)
    app.add_typer(group, name="bench")
