"""``pebble bench``: a command for each comparison, and one for a report of all."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer

from pebble.errors import PebbleError
from pebble.extensions.operator.commands.options import Output, Quick, split_names

FOLDER, REPORT = Path("bench-results"), Path("build/report")
_LONGEST_S = 3600.0  # of one phase
_MODULES = {"impair": "impair.trials"}  # of comparisons that are not in the module of their name

Variants = Annotated[str | None, typer.Option(help="Some of them, separated by commas.", metavar="NAMES")]
Seconds = Annotated[
    float | None, typer.Option(help="Duration of each case in a round.", min=0.1, max=_LONGEST_S, show_default=False)
]

app = typer.Typer(
    rich_markup_mode=None,
    help="""Comparisons, side by side in one run on this machine.

\b
    pebble bench frames
    pebble bench impair --quick
    pebble bench report
""",
)


@app.command()
def control(
    variants: Variants = None,
    rounds: Annotated[int | None, typer.Option(help="Rounds of all cases.", min=1, max=10_000)] = None,
    quick: Quick = False,
    output: Output = FOLDER,
) -> int:
    """Messages between two services: MQTT and Zenoh; unloaded, and beside camera frames.

    Each round starts two processes and a broker or hub for each variant. Needs mosquitto.

    \b
        pebble bench control
        pebble bench control --variants mqtt,zenoh-p2p --rounds 20
    """
    return _run("control", quick, output, variants=variants, rounds=rounds)


@app.command()
def bridge(seconds: Seconds = None, quick: Quick = False, output: Output = FOLDER) -> int:
    """Drive commands from an operator to the wheels of a whole simulated robot, and its telemetry back.

    On MQTT, on Zenoh and on plain paho, a stand-in for the original, beside one hop through a stock broker. Needs
    mosquitto.
    """
    return _run("bridge", quick, output, seconds=seconds)


@app.command()
def startup(quick: Quick = False, output: Output = FOLDER) -> int:
    """Start of a robot: the time to its first heartbeat, to all services ready, to its first drive command executed.

    Also the time until a service that connects later has all retained messages. Every launch is a new simulated robot.
    Needs mosquitto.
    """
    return _run("startup", quick, output)


@app.command()
def cost(quick: Quick = False, output: Output = FOLDER) -> int:
    """Cost of a robot: memory and CPU of each of its processes.

    Idle, driven 20 times a second, and sending pictures (640x480, 15 per second) and sound to an operator. Whole
    simulated robots; needs mosquitto.
    """
    return _run("cost", quick, output)


@app.command()
def frames(variants: Variants = None, seconds: Seconds = None, quick: Quick = False, output: Output = FOLDER) -> int:
    """Camera frames from one process to others: latency and CPU."""
    return _run("frames", quick, output, variants=variants, seconds=seconds)


@app.command()
def scale(quick: Quick = False, output: Output = FOLDER) -> int:
    """Cost of many boards for a server of the operator page: CPU, memory, latency. Needs mosquitto."""
    return _run("scale", quick, output)


@app.command()
def traffic(quick: Quick = False, output: Output = FOLDER) -> int:
    """Traffic of the demo's robots as in the paper's section 4.1: bandwidth, outages and latency.

    Needs mosquitto and the packages of the extra "archive".
    """
    return _run("traffic", quick, output)


@app.command()
def impair(
    trials: Annotated[str | None, typer.Option(help="Some of them, separated by commas.", metavar="NAMES")] = None,
    subjects: Annotated[
        str | None, typer.Option(help='Such as "mqtt original,zenoh h264 opus".', metavar="NAMES")
    ] = None,
    quick: Quick = False,
    output: Output = FOLDER,
) -> int:
    """Robots behind an impaired network: the trials of the paper's section 4.2.

    Simulated robots on MQTT and on Zenoh, with the original's encodings and with H.264 and Opus, each with its own
    network to its broker. In each trial the network has a low rate, loses packets, or both; an operator drives the
    robot and receives its video and audio. Needs mosquitto and network namespaces, so usually root.

    \b
        pebble bench impair --quick
        pebble bench impair --trials base-start,256k,64k+5%
        pebble bench impair --subjects "mqtt h264 opus"
    """
    return _run("impair", quick, output, trials=trials, subjects=subjects)


@app.command()
def report(
    folder: Annotated[
        Path, typer.Argument(help="Folder for results, pictures and README.md.", metavar="FOLDER")
    ] = REPORT,
    quick: Quick = False,
    only: Annotated[str | None, typer.Option(help="Some of them, separated by commas.", metavar="NAMES")] = None,
) -> int:
    """Run all comparisons, one after the other, and write a report.

    Takes some 65 minutes, with --quick some six minutes. If a comparison fails, the others still run, and the
    exit code is 1. Without root, impair is left out.
    """
    from rich.console import Console

    from pebble.extensions.lab.bench.report import SECTIONS, run

    names = () if only is None else _chosen("only", only, [section.name for section in SECTIONS])
    return run(names, folder, quick=quick, console=Console(highlight=False))


def _chosen(option: str, text: str, available: Collection[str]) -> tuple[str, ...]:
    """Return the names in a text that separates them by commas. Raises PebbleError for an unknown one."""
    names = split_names(text)
    if unknown := [name for name in names if name not in available]:
        raise PebbleError(f"--{option}: unknown {', '.join(unknown)}: there are {', '.join(available)}")
    if len(set(names)) < len(names):
        raise PebbleError(f"--{option}: name each one once")
    return tuple(names)


def _run(name: str, quick: bool, output: Path, **options: Any) -> int:
    """Run the comparison ``name``, print and write its results; return 0 if they are complete. Raises PebbleError.

    ``options`` replace fields of its Settings, unless they are None. An option that is a text lists values, separated
    by commas; each must be one that the field has in the comparison's FULL settings.
    """
    from rich.console import Console

    from pebble.extensions.lab.bench.results import check_folder
    from pebble.extensions.lab.bench.show import finish
    from pebble.extensions.operator.signals import interrupted_by_signals
    from pebble.transports.segments import sweep

    comparison = import_module(f"pebble.extensions.lab.bench.{_MODULES.get(name, name)}")
    settings, console = comparison.QUICK if quick else comparison.FULL, Console()
    for option, value in options.items():
        if isinstance(value, str):
            settings = replace(settings, **{option: _chosen(option, value, getattr(comparison.FULL, option))})
        elif value is not None:
            settings = replace(settings, **{option: value})
    check_folder(output)
    with interrupted_by_signals():
        try:
            shown = comparison.run(settings, console)
        finally:
            sweep()  # Zenoh leaves files behind even after a regular end
    shown.results.quick = quick
    return finish(shown, output, console)


def register(parent: typer.Typer) -> None:
    parent.add_typer(app, name="bench")
