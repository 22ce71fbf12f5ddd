"""``pebble bench``: comparisons, side by side in one run on this machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pebble.commands import bench_bridge, bench_compare, bench_control, bench_report, bench_robot

_GROUP_HELP = """Comparisons, side by side in one run on this machine.

\b
    pebble bench frames
    pebble bench control --with-media
    pebble bench fleet --robots 200
"""
_Json = Annotated[Path | None, typer.Option("--json", help="Write the figures to this file.", metavar="FILE")]


def frames(
    seconds: Annotated[float, typer.Option(min=0.1, help="How long each case runs in each round.")] = 3.0,
    rounds: Annotated[int, typer.Option(min=1, help="How often everything is run; figures are medians.")] = 3,
    size: Annotated[
        list[str] | None, typer.Option(help="640x480; may be given several times. [default: 640x480, 1920x1080]")
    ] = None,
    readers: Annotated[
        list[int] | None, typer.Option(min=1, max=16, help="May be given several times. [default: 1, 3]")
    ] = None,
    variants: Annotated[
        str | None, typer.Option(help="Some of them, separated by commas. [default: all]", metavar="NAMES")
    ] = None,
    json: _Json = None,
) -> int:
    """Camera frames from one process to others: latency, CPU and memory.

    BGR pictures at 30 Hz through Zenoh shared memory (without copies, and with), Zenoh without shared memory, MQTT
    through mosquitto, GStreamer's shared memory, and beside them a bare copy. All variants in turn, round after round.

    \b
        pebble bench frames
        pebble bench frames --size 640x480 --readers 1 --variants zenoh-shm,gstreamer-shm --json frames.json
    """
    from pebble.bench.frames import READERS, SIZES, Plan, run
    from pebble.bench.frames_variants import VARIANTS

    return run(
        Plan(
            seconds=seconds,
            rounds=rounds,
            sizes=size or SIZES,
            readers=readers or READERS,
            variants=VARIANTS if variants is None else [name.strip() for name in variants.split(",")],
            json=json,
        )
    )


def control(
    with_media: Annotated[
        bool, typer.Option("--with-media", help="Also while 1080p pictures and sound flow, and compare.")
    ] = False,
    seconds: Annotated[float, typer.Option(min=1, help="How long each phase is driven in each round.")] = 10.0,
    rounds: Annotated[int, typer.Option(min=1, help="How often each phase comes.")] = 3,
    transport: Annotated[list[str] | None, typer.Option(help="mqtt or zenoh. [default: both]")] = None,
    json: _Json = None,
) -> int:
    """Drive commands from an operator to the wheels of a whole simulated robot: latency at 20 Hz.

    With --with-media also while its camera gives 1920x1080 at 30 Hz to a program on the robot, and video and
    audio go to an operator. One robot on MQTT, one on Zenoh; needs mosquitto.

    \b
        pebble bench control
        pebble bench control --with-media --json control.json
    """
    from pebble.bench.control import KINDS, Plan, run

    return run(Plan(seconds=seconds, rounds=rounds, kinds=transport or KINDS, with_media=with_media, json=json))


def video(
    seconds: Annotated[float, typer.Option(min=1, help="Length of the film.")] = 10.0,
    json: _Json = None,
) -> int:
    """Video on the wire: bytes of every form at equal quality, on the same film."""
    from pebble.bench.video import run

    return run(json, seconds)


def sound(json: _Json = None) -> int:
    """Sound on the wire: bytes of every form, with all headers."""
    from pebble.bench.sound import run

    return run(json)


def fleet(
    robots: Annotated[int, typer.Option(min=1, help="How many robots with Wi-Fi.")] = 200,
    seconds: Annotated[float, typer.Option(min=1, help="How long they are driven.")] = 60.0,
    rate: Annotated[float, typer.Option(min=0.1, help="Commands a second to each of them.")] = 10.0,
    json: _Json = None,
) -> int:
    """MCU robots by the hundred on one broker: hearts, command latency, cost.

    The real firmware files on simulated pins, real TCP; one operator drives all of them. Needs mosquitto.

    \b
        pebble bench fleet
        pebble bench fleet --robots 20 --seconds 10 --json fleet.json
    """
    from pebble.bench.fleet import Plan, run

    return run(Plan(robots=robots, seconds=seconds, rate_hz=rate, json=json))


def register(app: typer.Typer) -> None:
    group = typer.Typer(help=_GROUP_HELP, rich_markup_mode=None)
    for command in (frames, control, fleet, video, sound):
        group.command(command.__name__)(command)
    for more in (bench_control, bench_bridge, bench_robot, bench_compare, bench_report):
        more.register(group)
    app.add_typer(group, name="bench")
