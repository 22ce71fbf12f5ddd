"""``pebble bench``: comparisons, side by side in one run on this machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pebble.bench.output import FOLDER
from pebble.commands import bench_control, bench_robot
from pebble.commands.options import Output, Quick, split_names
from pebble.errors import PebbleError

_GROUP_HELP = """Comparisons, side by side in one run on this machine.

\b
    pebble bench frames
    pebble bench fleet --robots 200
"""


def frames(
    seconds: Annotated[
        float | None, typer.Option(min=0.1, help="Duration of each case in a round. [default: 0.5]")
    ] = None,
    rounds: Annotated[int | None, typer.Option(min=2, help="Rounds of all cases. [default: 8]")] = None,
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
        typer.Option(help="Only this one, against itself and against itself slowed by a fifth.", metavar="VARIANT"),
    ] = None,
    quick: Quick = False,
    output: Output = FOLDER,
) -> int:
    """Camera frames from one process to others: latency, CPU and memory.

    BGR pictures at 30 Hz through Zenoh shared memory (without copies, and with), Zenoh without shared memory, MQTT
    through mosquitto, and GStreamer's shared memory, compared with a bare copy. Each round measures every variant.

    With --null: one variant, one size (640x480), one reader, 30 rounds of 0.4 s. The run fails if it finds a
    difference where there is none, or misses the planted one.

    \b
        pebble bench frames
        pebble bench frames --size 640x480 --readers 1 --variants zenoh-shm,gstreamer-shm
        pebble bench frames --null zenoh-shm
    """
    from pebble.bench import frames as comparison
    from pebble.bench import frames_null

    if null is not None and variants is not None:
        raise PebbleError("--null names the variant: leave --variants out")
    chosen = variants if null is None else null
    names = None if chosen is None else split_names(chosen)
    given = {"seconds": seconds, "rounds": rounds, "sizes": size, "readers": readers, "variants": names}
    run, plan = (comparison.run, comparison.plan) if null is None else (frames_null.run, frames_null.plan)
    return run(plan(quick=quick, output=output, **{name: value for name, value in given.items() if value}))


def video(
    seconds: Annotated[float | None, typer.Option(min=1, help="Length of the film. [default: 10]")] = None,
    quick: Quick = False,
    output: Output = FOLDER,
) -> int:
    """Video on the wire: bytes of every encoding at equal quality, for the same film."""
    from pebble.bench.video import run

    return run(output, seconds, quick=quick)


def sound(output: Output = FOLDER) -> int:
    """Sound on the wire: bytes of every encoding, with all headers."""
    from pebble.bench.sound import run

    return run(output)


def fleet(
    robots: Annotated[int | None, typer.Option(min=1, help="How many robots with Wi-Fi. [default: 200]")] = None,
    seconds: Annotated[float | None, typer.Option(min=1, help="Driving time. [default: 60]")] = None,
    rate: Annotated[float, typer.Option(min=0.1, help="Commands a second to each robot.")] = 10.0,
    quick: Quick = False,
    output: Output = FOLDER,
) -> int:
    """Hundreds of MCU robots on one broker: heartbeats, command latency, cost.

    The real firmware files on simulated pins, real TCP; one operator drives all of them. Needs mosquitto.

    \b
        pebble bench fleet
        pebble bench fleet --robots 20 --seconds 10
    """
    from pebble.bench.fleet import plan, run

    given = {name: value for name, value in {"robots": robots, "seconds": seconds}.items() if value}
    return run(plan(quick=quick, rate_hz=rate, output=output, **given))


def traffic(quick: Quick = False, output: Output = FOLDER) -> int:
    """Traffic of the demo's robots as in the paper's section 4.1: bandwidth, outages and latency.

    Records four simulated robots at a real broker, idle, then driven and watched, and analyses the recording as
    pebble analyse does. Needs mosquitto and the packages of the extra "archive".
    """
    from pebble.bench.traffic import plan, run

    return run(plan(quick=quick, output=output))


def compare(
    a: Annotated[Path, typer.Argument(help="Results of the older run.", metavar="A.json", show_default=False)],
    b: Annotated[Path, typer.Argument(help="Results of the newer run.", metavar="B.json", show_default=False)],
    threshold: Annotated[float, typer.Option(help="Smaller factors never count as a change.")] = 1.05,
    everything: Annotated[bool, typer.Option("--all", help="Also list what did not change.")] = False,
) -> int:
    """Did anything get worse from A to B, beyond noise? Exit code 1 if so.

    Both files must come from the same comparison, if possible on the same machine with the same options. The ratios of
    the medians and of the p99 of each cell are tested with confidence intervals over rounds.

    \b
        pebble bench frames --output before
        pebble bench frames --output after
        pebble bench compare before/frames.json after/frames.json
    """
    from pebble.bench.compare_report import run

    return run(a, b, threshold=threshold, everything=everything)


def report(
    folder: Annotated[Path, typer.Argument(help="Folder for results, pictures and README.md.", metavar="FOLDER")],
    quick: Quick = False,
    only: Annotated[
        str | None, typer.Option(help="Some of them, separated by commas. [default: all]", metavar="NAMES")
    ] = None,
    render: Annotated[
        bool, typer.Option("--render", help="Measure nothing: only write pictures and README.md again.")
    ] = False,
) -> int:
    """Run all comparisons and pebble impair, one after the other, and write a report.

    Takes a little over an hour, with --quick less than five minutes. If a comparison fails, the others still run, and
    the exit code is 1. Without root, comparisons that need it are left out.

    \b
        pebble bench report docs/results
        pebble bench report build/report-quick --quick
        pebble bench report bench-results --only control,control-null
        pebble bench report docs/results --render
    """
    from pebble.bench.report import run, write
    from pebble.bench.report_plan import chosen, needs_root

    if render:
        typer.echo(f"Written: {write(folder)}")
        return 0
    names = [] if only is None else split_names(only)
    return run(chosen(names), folder, quick=quick, left_out=[] if names else needs_root())


def register(app: typer.Typer) -> None:
    group = typer.Typer(help=_GROUP_HELP, rich_markup_mode=None)
    commands = (frames, fleet, video, sound, traffic, *bench_control.COMMANDS, *bench_robot.COMMANDS, compare, report)
    for command in commands:
        group.command(command.__name__)(command)
    app.add_typer(group, name="bench")
