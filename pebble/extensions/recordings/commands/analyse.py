"""``pebble analyse``: bandwidth, sessions, outages and latency of recordings, as a report."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from pebble.extensions.operator.commands.options import Output
from pebble.extensions.recordings.commands.options import RecordingsArgument, Since, Until, period
from pebble.extensions.recordings.commands.report import errors_of_files
from pebble.runtime.as_owner import as_owner

if TYPE_CHECKING:
    from pebble.extensions.recordings.traffic.results import RobotTraffic, Traffic

FOLDER: Final = Path("report")

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
    from pebble.extensions.recordings.traffic.duck import require_packages

    require_packages("duckdb", "matplotlib")
    from pebble.config.visible import shown
    from pebble.extensions.operator.client.names import base_of
    from pebble.extensions.recordings.catalogue import check_name
    from pebble.extensions.recordings.commands.progress import progress_of_steps
    from pebble.extensions.recordings.traffic.analysis import analyse as analyse_traffic
    from pebble.extensions.recordings.traffic.report import write_report
    from pebble.extensions.recordings.traffic.sources import sources

    since_ns, until_ns = period(since, until)
    bases = [base_of(name) for name in robot or ()]
    with as_owner(output), errors_of_files():
        output.mkdir(parents=True, exist_ok=True)  # before the work, not after it
    with (
        as_owner(output),
        tempfile.TemporaryDirectory(prefix="pebble-analyse-") as folder,
        progress_of_steps() as progress,
    ):
        scratch = Path(folder)
        with errors_of_files():
            indexed = sources(places, scratch, progress)
        for line in indexed.unread:
            typer.echo(f"pebble: {shown(line)}", err=True)
        if not indexed.unread:  # else a robot may be in what could not be read
            for base in bases:
                check_name("robot", base, indexed.robots, places)
        traffic = analyse_traffic(
            indexed, scratch, since_ns=since_ns, until_ns=until_ns, robots=bases, progress=progress
        )
        written = write_report(traffic, output, csv=csv, advance=progress)
    _print(traffic, written)
    return 1 if indexed.unread else 0


def _print(traffic: Traffic, written: list[Path]) -> None:
    from pebble.config.visible import shown
    from pebble.extensions.operator.commands.show import print_table
    from pebble.extensions.recordings.traffic.report import remarks

    columns = ("robot", "messages", "sessions", "outages", "latency", "video", "audio")
    rows = ((robot.robot.rpartition("/")[2], *_cells(robot)) for robot in traffic.robots)
    print_table(columns, rows, whole=(), right=columns[1:])
    typer.secho("Medians: latency of heartbeats in ms, video and audio in kbit/s.", dim=True)
    for remark in remarks(traffic):
        typer.echo(shown(remark))
    for path in written:
        typer.secho(f"Written: {path}", dim=True)


def _cells(robot: RobotTraffic) -> Iterator[str]:
    from pebble.extensions.recordings.traffic.results import AUDIO, VIDEO

    yield from (f"{robot.messages:,}", str(len(robot.sessions)), str(len(robot.outages)))
    latency = robot.latency
    yield "" if latency is None else f"{latency.median_ms:.0f}"
    for family in (VIDEO, AUDIO):
        bandwidth = robot.of(family)
        yield "" if bandwidth is None else f"{bandwidth.median_kbps:.1f}"
