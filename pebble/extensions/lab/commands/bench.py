"""``pebble bench``: a command for each comparison, and one for a report of all."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from pebble.commands.options import Output, Quick, split_names
from pebble.errors import PebbleError

if TYPE_CHECKING:
    from rich.console import Console

    from pebble.extensions.lab.bench.show import Shown

FOLDER, REPORT = Path("bench-results"), Path("build/report")
_LONGEST_S = 3600.0  # of one phase

Variants = Annotated[str | None, typer.Option(help="Some of them, separated by commas.", metavar="NAMES")]
Seconds = Annotated[
    float | None, typer.Option(help="Duration of each case in a round.", min=0.1, max=_LONGEST_S, show_default=False)
]
Rounds = Annotated[int | None, typer.Option(help="Rounds of all cases.", min=1, max=10_000, show_default=False)]

S = TypeVar("S")
N = TypeVar("N", int, float)

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
    sizes: Annotated[str | None, typer.Option(help="For example 40,1024.", metavar="BYTES")] = None,
    rates: Annotated[str | None, typer.Option(help="Messages a second, for example 20,200.", metavar="HZ")] = None,
    loads: Annotated[str | None, typer.Option(help="Some of none, media and hog.", metavar="NAMES")] = None,
    seconds: Seconds = None,
    rounds: Rounds = None,
    quick: Quick = False,
    output: Output = FOLDER,
) -> int:
    """Round trips between two services: MQTT and Zenoh; unloaded, with camera frames, beside a busy process.

    Each round starts two processes and a broker or hub for each variant. Needs mosquitto.

    \b
        pebble bench control
        pebble bench control --variants mqtt,zenoh-p2p --sizes 40 --rates 200 --rounds 20
    """
    from pebble.extensions.lab.bench import control as comparison

    settings = _settings(
        comparison.QUICK if quick else comparison.FULL,
        variants=_chosen("variants", variants, comparison.VARIANTS),
        sizes=_numbers("sizes", sizes, int, least=40, most=1 << 20),
        rates=_numbers("rates", rates, float, least=1, most=2000),
        loads=_chosen("loads", loads, comparison.LOADS),
        seconds=seconds,
        rounds=rounds,
    )
    return _run(comparison.run, settings, quick, output)


@app.command()
def bridge(
    variants: Variants = None,
    with_media: Annotated[bool, typer.Option("--with-media", help="Also with 1080p pictures and sound.")] = False,
    seconds: Annotated[
        float | None,
        typer.Option(help="Driving time per robot and round, under each load.", min=0.1, max=_LONGEST_S),
    ] = None,
    rounds: Rounds = None,
    quick: Quick = False,
    output: Output = FOLDER,
) -> int:
    """Drive commands from an operator to the wheels of a whole simulated robot, and its telemetry back.

    On MQTT, on Zenoh and on plain paho, a stand-in for the original, beside one hop through a stock broker. Needs
    mosquitto.
    """
    from pebble.extensions.lab.bench import bridge as comparison

    full = comparison.QUICK if quick else comparison.FULL
    chosen = _chosen("variants", variants, full.variants)
    settings = _settings(full, variants=chosen, with_media=with_media, seconds=seconds, rounds=rounds)
    return _run(comparison.run, settings, quick, output)


@app.command()
def startup(variants: Variants = None, rounds: Rounds = None, quick: Quick = False, output: Output = FOLDER) -> int:
    """How fast a robot starts: first heartbeat, all services ready, first drive command executed.

    And how fast an operator or a service that connects later receives all retained messages, and how long an operator
    waits for the first picture in each encoding. Every launch is a new simulated robot. Needs mosquitto.
    """
    from pebble.extensions.lab.bench import startup as comparison

    full = comparison.QUICK if quick else comparison.FULL
    settings = _settings(full, variants=_chosen("variants", variants, full.variants), rounds=rounds)
    return _run(comparison.run, settings, quick, output)


@app.command()
def cost(variants: Variants = None, rounds: Rounds = None, quick: Quick = False, output: Output = FOLDER) -> int:
    """What a robot costs: memory, CPU and threads of each of its processes.

    Idle, driven 20 times a second, and sending pictures (640x480, 15 per second) and sound to an operator in two
    forms. Whole simulated robots; needs mosquitto.
    """
    from pebble.extensions.lab.bench import cost as comparison

    full = comparison.QUICK if quick else comparison.FULL
    settings = _settings(full, variants=_chosen("variants", variants, full.variants), rounds=rounds)
    return _run(comparison.run, settings, quick, output)


@app.command()
def frames(
    variants: Variants = None,
    size: Annotated[str | None, typer.Option(help="Such as 640x480,1920x1080.", metavar="SIZES")] = None,
    seconds: Seconds = None,
    rounds: Rounds = None,
    quick: Quick = False,
    output: Output = FOLDER,
) -> int:
    """Camera frames from one process to others: latency, CPU and memory."""
    from pebble.extensions.lab.bench import frames as comparison

    settings = _settings(
        comparison.QUICK if quick else comparison.FULL,
        variants=_chosen("variants", variants, comparison.VARIANTS),
        size=_chosen("size", size, comparison.SIZES),
        seconds=seconds,
        rounds=rounds,
    )
    return _run(comparison.run, settings, quick, output)


@app.command()
def scale(
    boards: Annotated[str | None, typer.Option(help="For example 10,100,1000.", metavar="NUMBERS")] = None,
    quick: Quick = False,
    output: Output = FOLDER,
) -> int:
    """What many boards cost a server of the operator page, and a hub: CPU, memory, latency. Needs mosquitto."""
    from pebble.extensions.lab.bench import scale as comparison

    numbers = _numbers("boards", boards, int, least=1, most=comparison.MOST)
    settings = _settings(comparison.QUICK if quick else comparison.FULL, boards=numbers)
    return _run(comparison.run, settings, quick, output)


@app.command()
def traffic(quick: Quick = False, output: Output = FOLDER) -> int:
    """Traffic of the demo's robots as in the paper's section 4.1: bandwidth, outages and latency.

    Needs mosquitto and the packages of the extra "archive".
    """
    from pebble.extensions.lab.bench import traffic as comparison

    return _run(comparison.run, comparison.QUICK if quick else comparison.FULL, quick, output)


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
    from pebble.extensions.lab.bench.impair import trials as comparison

    settings = _settings(
        comparison.QUICK if quick else comparison.FULL,
        trials=_chosen("trials", trials, comparison.TRIALS),
        subjects=_chosen("subjects", subjects, comparison.SUBJECTS),
    )
    return _run(comparison.run, settings, quick, output)


@app.command()
def report(
    folder: Annotated[
        Path, typer.Argument(help="Folder for results, pictures and README.md.", metavar="FOLDER")
    ] = REPORT,
    quick: Quick = False,
    only: Annotated[str | None, typer.Option(help="Some of them, separated by commas.", metavar="NAMES")] = None,
) -> int:
    """Run all comparisons, one after the other, and write a report.

    Takes an hour and a quarter, with --quick some five minutes. If a comparison fails, the others still run, and the
    exit code is 1. Without root, impair is left out.
    """
    from rich.console import Console

    from pebble.extensions.lab.bench.report import SECTIONS, run

    names = _chosen("only", only, [section.name for section in SECTIONS]) or ()
    return run(names, folder, quick=quick, console=Console(highlight=False))


def _settings(settings: S, **given: object) -> S:
    """Return the settings with the options that are given."""
    return replace(settings, **{name: value for name, value in given.items() if value is not None})  # type: ignore[type-var]


def _chosen(option: str, text: str | None, known: Collection[str]) -> tuple[str, ...] | None:
    """Return names that are separated by commas; None for no option. Raises PebbleError for an unknown one."""
    if text is None:
        return None
    names = split_names(text)
    if unknown := [name for name in names if name not in known]:
        raise PebbleError(f"--{option}: unknown {', '.join(unknown)}: there are {', '.join(known)}")
    if len(set(names)) < len(names):
        raise PebbleError(f"--{option}: name each one once")
    return tuple(names)


def _numbers(option: str, text: str | None, kind: type[N], *, least: float, most: float) -> tuple[N, ...] | None:
    """Return numbers that are separated by commas; None for no option. Raises PebbleError."""
    try:
        numbers = None if text is None else tuple(kind(number) for number in split_names(text))
    except ValueError:
        raise PebbleError(f"--{option}: {text} is not a list of numbers") from None
    for number in numbers or ():
        if not least <= number <= most:
            raise PebbleError(f"--{option} {number:g}: must be at least {least:g} and at most {most:g}")
    return numbers


def _run(run: Callable[[Any, Console], Shown], settings: Any, quick: bool, output: Path) -> int:
    """Measure, print and write; returns 0 if everything has results of enough rounds. Raises PebbleError."""
    from rich.console import Console

    from pebble.extensions.lab.bench.results import check_folder
    from pebble.extensions.lab.bench.show import finish
    from pebble.runtime.signals import interrupted_by_signals
    from pebble.transports.segments import sweep

    console = Console()
    check_folder(output)
    with interrupted_by_signals():
        try:
            shown = run(settings, console)
        finally:
            sweep()  # Zenoh leaves files behind even after a regular end
    shown.results.quick = quick
    return finish(shown, output, console)


def register(parent: typer.Typer) -> None:
    parent.add_typer(app, name="bench")
