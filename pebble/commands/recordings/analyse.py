"""``pebble analyse``: bandwidth, sessions, outages and latency of recordings, as a report."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from pebble.commands.options import Output
from pebble.commands.recordings.options import RecordingsArgument, Since, Until

if TYPE_CHECKING:
    from pebble.recordings.traffic.results import RobotTraffic, Traffic
    from pebble.recordings.traffic.sources import Progress

FOLDER: Final = Path("report")
_QUIET_S: Final = 2.0  # before progress is shown

Robots = Annotated[
    list[str] | None, typer.Option("--robot", "-r", help="Only this one; may be repeated.", metavar="[SYSTEM/TYPE/]ID")
]


def analyse(
    places: RecordingsArgument,
    since: Since = None,
    until: Until = None,
    robot: Robots = None,
    output: Output = FOLDER,
    csv: Annotated[bool, typer.Option("--csv", help="Write each table as a CSV file, too.")] = False,
) -> int:
    """Bandwidth, sessions, outages and latency of recordings.

    Writes one HTML page with the figures of the paper's section 4.1 for every robot. A folder may be analysed while
    it is recorded to. Each recording is indexed first, in a .parquet beside it, which may be deleted. Needs the
    packages of the extra "archive".

    \b
        pebble analyse recordings/
        pebble analyse recordings/ --since 10:00 --until +30m --robot goob
        pebble analyse recordings/2026/11/20 --csv --output monday/
    """
    from pebble.recordings.traffic.duck import require_packages

    require_packages("duckdb", "matplotlib")
    from pebble.client.names import base_of
    from pebble.config.visible import shown
    from pebble.recordings.catalogue import check_name
    from pebble.recordings.period import parse_period
    from pebble.recordings.traffic.analysis import analyse as analyse_traffic
    from pebble.recordings.traffic.report import write_report
    from pebble.recordings.traffic.sources import sources

    since_ns, until_ns = parse_period(since, until, now=datetime.now())
    bases = [base_of(name) for name in robot or ()]
    with _errors_of_files():
        output.mkdir(parents=True, exist_ok=True)  # before the work, not after it
    with tempfile.TemporaryDirectory(prefix="pebble-analyse-") as folder, _progress() as progress:
        scratch = Path(folder)
        with _errors_of_files():
            found = sources(places, scratch, progress)
        for line in found.unread:
            typer.echo(f"pebble: {shown(line)}", err=True)
        for base in () if found.unread else bases:
            check_name("robot", base, found.robots, places)
        traffic = analyse_traffic(found, scratch, since_ns=since_ns, until_ns=until_ns, robots=bases, progress=progress)
        written = write_report(traffic, output, csv=csv, advance=progress)
    _print(traffic, written)
    return 1 if found.unread else 0


@contextmanager
def _errors_of_files() -> Iterator[None]:
    """Raise PebbleError for OSError."""
    from pebble.errors import PebbleError

    try:
        yield
    except OSError as error:
        raise PebbleError(f"{error.filename}: {error.strerror}") from None


@contextmanager
def _progress() -> Iterator[Progress]:
    """What is done and how far it is, from two seconds after the start on; on a terminal only."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    bar = Progress(
        TextColumn("{task.description}", markup=False), BarColumn(), console=Console(stderr=True), transient=True
    )
    task = bar.add_task("", total=1.0)
    quiet_until, shown = time.monotonic() + _QUIET_S, False

    def show(what: str, share: float) -> None:
        nonlocal shown
        bar.update(task, description=what, completed=share)
        if not shown and time.monotonic() >= quiet_until and bar.console.is_terminal:
            bar.start()
            shown = True

    try:
        yield show
    finally:
        if shown:
            bar.stop()


def _print(traffic: Traffic, written: list[Path]) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from pebble.config.visible import shown
    from pebble.recordings.traffic.report import remarks

    table = Table(box=box.SIMPLE_HEAD)
    for heading in ("robot", "messages", "sessions", "outages", "latency", "video", "audio"):
        is_name = heading == "robot"
        table.add_column(
            heading, justify="left" if is_name else "right", no_wrap=True, min_width=8 if is_name else None
        )
    for robot in traffic.robots:
        table.add_row(Text(shown(robot.robot.rpartition("/")[2])), *_cells(robot))
    console = Console()
    console.print(table)
    console.print("Medians: latency of heartbeats in ms, video and audio in kbit/s.", style="dim", soft_wrap=True)
    for remark in remarks(traffic):
        console.print(shown(remark), markup=False, highlight=False, soft_wrap=True)
    for path in written:
        console.print(f"Written: {path}", style="dim", markup=False, highlight=False, soft_wrap=True)


def _cells(robot: RobotTraffic) -> Iterator[str]:
    from pebble.recordings.traffic.results import AUDIO, VIDEO

    yield from (f"{robot.messages:,}", str(len(robot.sessions)), str(len(robot.outages)))
    latency = robot.latency
    yield "" if latency is None else f"{latency.median_ms:.0f}"
    for family in (VIDEO, AUDIO):
        bandwidth = robot.of(family)
        yield "" if bandwidth is None else f"{bandwidth.median_kbps:.1f}"
