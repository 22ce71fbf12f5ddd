"""One table of all measurements of real robots in a folder, a column for each label, from their recordings."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any, Final

import msgspec
from rich import box
from rich.table import Table
from rich.text import Text

from pebble.bench.impair.real_robot import NAME, Measurement
from pebble.client.names import id_of
from pebble.contract import AUDIO as AUDIO_CHANNEL
from pebble.contract import CAMERA
from pebble.errors import PebbleError
from pebble.recordings.files.reader import RecordingError
from pebble.recordings.library import FOREVER_NS
from pebble.recordings.traffic.analysis import analyse
from pebble.recordings.traffic.duck import require_packages
from pebble.recordings.traffic.report import remarks
from pebble.recordings.traffic.results import FAMILIES, RobotTraffic, Stream, Traffic
from pebble.recordings.traffic.sources import sources

_NONE: Final = "–"


class Column(msgspec.Struct):
    """One measurement, analysed."""

    measurement: Measurement
    traffic: Traffic | None  # None: no message arrived
    problem: str = ""

    @property
    def robot(self) -> RobotTraffic | None:
        return None if self.traffic is None else self.traffic.robots[0]

    @property
    def seconds(self) -> float:
        until_ns = self.measurement.until_ns
        if until_ns == FOREVER_NS and self.traffic is not None:  # the program was killed
            until_ns = self.traffic.until_ns
        return 0.0 if until_ns == FOREVER_NS else (until_ns - self.measurement.since_ns) / 1e9

    def stream(self, metric: str) -> Stream | None:
        return None if self.robot is None else next((one for one in self.robot.streams if one.metric == metric), None)

    @property
    def remarks(self) -> list[str]:
        return [self.problem] if self.traffic is None else remarks(self.traffic)


def columns(into: Path) -> list[Column]:
    """All measurements in a folder, the oldest first. Raises PebbleError, also if there is none."""
    require_packages("duckdb", "zstandard")
    found = [(_load(path), path.parent) for path in sorted(into.glob(f"*/{NAME}"))]
    if not found:
        raise PebbleError(f"{into}: there is no measurement of a real robot: see pebble impair --help")
    return [_column(one, folder) for one, folder in sorted(found, key=lambda pair: pair[0].since_ns)]


def _load(path: Path) -> Measurement:
    try:
        return msgspec.json.decode(path.read_bytes(), type=Measurement)
    except OSError as error:
        raise PebbleError(f"{path}: {error.strerror}") from None
    except msgspec.DecodeError as error:
        raise PebbleError(f"{path}: {error}") from None


def _column(measurement: Measurement, folder: Path) -> Column:
    since_ns, until_ns = measurement.since_ns, measurement.until_ns
    with tempfile.TemporaryDirectory(prefix="pebble-impair-") as name:
        scratch = Path(name)
        try:
            found = sources([folder], scratch, robots=[measurement.robot], since_ns=since_ns, until_ns=until_ns)
            return Column(measurement, analyse(found, scratch, since_ns=since_ns, until_ns=until_ns))
        except RecordingError as error:
            return Column(measurement, None, str(error))


def table(found: list[Column]) -> Table:
    """Rows are the figures of the paper, columns the labels."""
    made = Table(box=box.SIMPLE_HEAD)
    made.add_column("", no_wrap=True)
    for column in found:
        made.add_column(Text(column.measurement.label), justify="right", no_wrap=True)
    for group in _groups():
        rows = [(name, [cell(column) for column in found]) for name, cell in group]
        shown = [(name, cells) for name, cells in rows if any(one != _NONE for one in cells)]
        for number, (name, cells) in enumerate(shown, 1):
            made.add_row(name, *map(Text, cells), end_section=number == len(shown))
    return made


_Row = tuple[str, Callable[[Column], str]]


def _groups() -> list[list[_Row]]:
    about: list[_Row] = [
        ("robot", lambda column: id_of(column.measurement.robot)),
        ("measured, s", lambda column: f"{column.seconds:.0f}"),
    ]
    heartbeats = [
        (
            "heartbeat latency p50, ms",
            _of_robot(lambda robot: _ms(None if robot.latency is None else robot.latency.median_ms)),
        ),
        (
            "heartbeat latency p95, ms",
            _of_robot(lambda robot: _ms(None if robot.latency is None else robot.latency.p95_ms)),
        ),
        ("heartbeat intervals", _of_robot(lambda robot: str(robot.intervals.count if robot.intervals else 0))),
        ("outages", _of_robot(lambda robot: str(len(robot.outages)))),
        ("outage, median, ms", _of_robot(lambda robot: _outage(robot, median))),
        ("outage, longest, ms", _of_robot(lambda robot: _outage(robot, max))),
        ("offline, times", _of_robot(lambda robot: str(robot.offline) if robot.offline else _NONE)),
    ]
    pictures: list[_Row] = [("pictures a second", _rate), *_media("pictures", CAMERA.metric)]
    bandwidths = [(f"{family}, kbit/s", _of_robot(_bandwidth(family))) for family in FAMILIES]
    return [about, heartbeats, pictures, _media("sound", AUDIO_CHANNEL.metric), bandwidths]


def _media(name: str, metric: str) -> list[_Row]:
    def cell(text: Callable[[Stream], str]) -> Callable[[Column], str]:
        return lambda column: _NONE if (stream := column.stream(metric)) is None else text(stream)

    return [
        (f"{name} lost", cell(lambda stream: f"{stream.lost_share:.1%}")),
        (f"{name}, jitter p50, ms", cell(lambda stream: _ms(stream.jitter_median_ms))),
        (f"{name}, jitter p95, ms", cell(lambda stream: _ms(stream.jitter_p95_ms))),
    ]


def _of_robot(text: Callable[[RobotTraffic], str]) -> Callable[[Column], str]:
    return lambda column: _NONE if column.robot is None else text(column.robot)


def _rate(column: Column) -> str:
    stream = column.stream(CAMERA.metric)
    return _NONE if stream is None or not column.seconds else f"{stream.messages / column.seconds:.1f}"


def _outage(robot: RobotTraffic, which: Callable[[list[float]], Any]) -> str:
    return _ms(which([one.length_ms for one in robot.outages])) if robot.outages else _NONE


def _bandwidth(family: str) -> Callable[[RobotTraffic], str]:
    def text(robot: RobotTraffic) -> str:
        one = robot.of(family)
        return _NONE if one is None else f"{one.median_kbps:.1f}"

    return text


def _ms(value: float | None) -> str:
    return _NONE if value is None else f"{value:.0f}" if abs(value) >= 10 else f"{value:.1f}"
