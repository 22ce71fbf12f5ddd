"""Measures a real robot behind the user's own network: requests its media, records it, and never drives it.

The table shows all measurements in a folder side by side, a column for each label, from their recordings.
"""

from __future__ import annotations

import re
import shutil
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any, Final

import msgspec
from rich import box
from rich.table import Table
from rich.text import Text

from pebble.bench.engine import check_folder
from pebble.client.connection import Target, connected, resolve
from pebble.client.names import id_of
from pebble.client.viewer import Medium, Viewer
from pebble.contract import AUDIO, CAMERA, ONLINE
from pebble.contract.identity import parse_topic
from pebble.errors import PebbleError
from pebble.recordings.files.reader import RecordingError
from pebble.recordings.library import FOREVER_NS
from pebble.recordings.recorder.recorder import Options, Recorder
from pebble.recordings.recorder.source import Source
from pebble.recordings.traffic.analysis import analyse
from pebble.recordings.traffic.duck import require_packages
from pebble.recordings.traffic.report import remarks
from pebble.recordings.traffic.results import FAMILIES, RobotTraffic, Stream, Traffic
from pebble.recordings.traffic.sources import sources
from pebble.transports import Message, QoS, Transport

NAME: Final = "impair.json"
_LABEL: Final = re.compile(r"(?!\d+$)[A-Za-z0-9][A-Za-z0-9._+%-]{0,63}")  # a recorder's own folders are digits
_HEARTBEAT_S: Final = 5.0
_CAPABILITIES_S: Final = 5.0
_FIRST_S: Final = 15.0  # a camera that is off takes a moment to open
_TURN_S: Final = 0.1
_MOST_NAMES: Final = 8
_NONE: Final = "–"
_MEDIA: Final[tuple[Medium, ...]] = ("video", "audio")

Progress = Callable[[str], None]


class Plan(msgspec.Struct, frozen=True, kw_only=True):
    """One measurement."""

    target: Target
    label: str
    into: Path
    seconds: float = 120.0
    media: bool = True
    replace: bool = False

    @property
    def folder(self) -> Path:
        return self.into / self.label


class Measurement(msgspec.Struct, kw_only=True):
    """What was measured, beside its recordings; times in nanoseconds since 1970."""

    label: str
    robot: str  # its base topic
    since_ns: int
    until_ns: int = FOREVER_NS
    format: int = 1

    def save(self, folder: Path) -> None:
        (folder / NAME).write_bytes(msgspec.json.format(msgspec.json.encode(self)) + b"\n")


def measure(plan: Plan, progress: Progress) -> Measurement:
    """Record the robot for the plan's time, or until KeyboardInterrupt. Raises PebbleError.

    Nothing is measured before all requested media have arrived, for at most 15 s. At the end the requests are
    withdrawn.
    """
    _check(plan)
    with connected(plan.target) as (transport, names):
        progress(f"waiting for a heartbeat of {id_of(names.base)}")
        _require_heartbeat(transport, names.base)
        with closing(Viewer(transport, names.base, None)) as viewer:
            if plan.media:
                viewer.wait_for_capabilities(_CAPABILITIES_S)
            _make_folder(plan)
            return _Course(plan, viewer, progress).run()


def _check(plan: Plan) -> None:
    if not _LABEL.fullmatch(plan.label):
        raise PebbleError(
            f'--label "{plan.label}" cannot name a folder: use letters, digits and . _ + % -, such as 512k'
        )
    require_packages("duckdb", "zstandard")
    if plan.folder.exists() and not plan.replace:
        raise PebbleError(f"{plan.folder} exists: add --replace to measure it again, or use another --label")
    if plan.folder.exists() and not (plan.folder / NAME).is_file():
        raise PebbleError(f"{plan.folder} is no measurement, so it is not replaced: use another --label or --into")


def _make_folder(plan: Plan) -> None:
    if plan.folder.exists():
        try:
            shutil.rmtree(plan.folder)
        except OSError as error:
            raise PebbleError(f"{error.filename}: {error.strerror}") from None
    check_folder(plan.folder)


def _require_heartbeat(transport: Transport, base: str) -> None:
    """Wait for a heartbeat of the robot. Raises PebbleError that names the robots that were received instead."""
    received: set[str] = set()

    def on_heartbeat(message: Message) -> None:
        address = parse_topic(message.topic)
        if address is not None and not message.retain:  # a retained heartbeat may be old
            received.add(address.identity.base)

    with closing(transport.subscribe(ONLINE.filter("+/+/+"), on_heartbeat, qos=QoS.LATEST, direct=True)):
        end = time.monotonic() + _HEARTBEAT_S
        while base not in received and time.monotonic() < end:
            time.sleep(_TURN_S)
    if base not in received:
        names = sorted(map(id_of, received))
        more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
        others = f"received instead: {', '.join(names[:_MOST_NAMES])}{more}" if names else "nor of any other robot"
        raise PebbleError(f"no heartbeat of {id_of(base)} came within {_HEARTBEAT_S:g} s; {others}")


class _Recorder(Recorder):
    """A recorder that notes for a viewer which media have arrived."""

    def __init__(self, plan: Plan, viewer: Viewer) -> None:
        super().__init__(plan.folder, Options(), {"impair": plan.label, "filters": f"{viewer.base}/#"})
        self.arrived: set[Medium] = set()
        self._viewer = viewer
        topics = {medium: viewer.capabilities.get(medium, {}).get("topic") for medium in _MEDIA}
        self._media = {topic: medium for medium, topic in topics.items() if isinstance(topic, str)}

    def receive(self, topic: str, payload: bytes, *about: Any, retained: bool = False, **more: Any) -> None:
        medium = self._media.get(topic)
        if medium is not None and not retained:
            self.arrived.add(medium)
            self._viewer.note_received(medium)
        super().receive(topic, payload, *about, retained=retained, **more)


class _Course:
    """The course of one measurement."""

    def __init__(self, plan: Plan, viewer: Viewer, progress: Progress) -> None:
        self._plan, self._viewer, self._progress = plan, viewer, progress
        kind, settings, _, _ = resolve(plan.target)
        settings = replace(settings, protocol="5") if kind == "mqtt" else settings
        self._recorder = _Recorder(plan, viewer)
        self._source = Source(self._recorder, kind, settings, [f"{viewer.base}/#"])

    def run(self) -> Measurement:
        self._recorder.start()
        try:
            with closing(self._source):
                self._source.start()
                return self._measured()
        finally:
            self._recorder.stop()

    def _measured(self) -> Measurement:
        measurement = Measurement(label=self._plan.label, robot=self._viewer.base, since_ns=self._recorder.clock.now())
        measurement.save(self._plan.folder)
        try:
            requested = self._request()
            self._watch(_FIRST_S, "waiting for pictures and sound", lambda: requested <= self._recorder.arrived)
            measurement.since_ns = self._recorder.clock.now()
            self._watch(self._plan.seconds, "measuring", lambda: False)
        except KeyboardInterrupt:
            pass  # what was measured until now is the measurement
        finally:
            measurement.until_ns = self._recorder.clock.now()
            measurement.save(self._plan.folder)
        return measurement

    def _request(self) -> set[Medium]:
        sections = self._viewer.capabilities if self._plan.media else {}
        offered = [one for one in _MEDIA if sections.get(one, {}).get("available") and sections[one].get("controls")]
        for medium in offered:
            self._viewer.request(medium)
        return set(offered)

    def _watch(self, seconds: float, what: str, is_over: Callable[[], bool]) -> None:
        began = checked = time.monotonic()
        while not is_over() and (now := time.monotonic()) - began < seconds:
            time.sleep(_TURN_S)
            if now - checked >= 1.0:
                checked = now
                self._source.check()
                self._viewer.repeat_requests()
            self._progress(f"{what}: {now - began:.0f} of {seconds:g} s{self._state()}")
            if self._recorder.blocked:
                raise PebbleError(f"{self._plan.folder}: {self._recorder.blocked}")

    def _state(self) -> str:
        counters = self._recorder.counters
        problem = "" if self._source.connected else f", not connected: {self._source.problem or 'no answer'}"
        return f", {counters['messages']:,} messages, {counters['bytes'] / 1e6:.1f} MB{problem}"


# -- all measurements side by side


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
    for group in _GROUPS:
        rows = [(name, [cell(column) for column in found]) for name, cell in group]
        shown = [(name, cells) for name, cells in rows if any(one != _NONE for one in cells)]
        for number, (name, cells) in enumerate(shown, 1):
            made.add_row(name, *map(Text, cells), end_section=number == len(shown))
    return made


_Row = tuple[str, Callable[[Column], str]]


def _of_robot(name: str, text: Callable[[RobotTraffic], str]) -> _Row:
    return name, lambda column: _NONE if column.robot is None else text(column.robot)


def _of_stream(name: str, metric: str, text: Callable[[Stream], str]) -> _Row:
    return name, lambda column: _NONE if (stream := column.stream(metric)) is None else text(stream)


def _media(name: str, metric: str) -> tuple[_Row, ...]:
    return (
        _of_stream(f"{name} lost", metric, lambda stream: f"{stream.lost_share:.1%}"),
        _of_stream(f"{name}, jitter p50, ms", metric, lambda stream: _ms(stream.jitter_median_ms)),
        _of_stream(f"{name}, jitter p95, ms", metric, lambda stream: _ms(stream.jitter_p95_ms)),
    )


def _rate(column: Column) -> str:
    stream = column.stream(CAMERA.metric)
    return _NONE if stream is None or not column.seconds else f"{stream.messages / column.seconds:.1f}"


def _outage(robot: RobotTraffic, which: Callable[[list[float]], float]) -> str:
    return _ms(which([one.length_ms for one in robot.outages])) if robot.outages else _NONE


def _bandwidth(family: str) -> _Row:
    def text(robot: RobotTraffic) -> str:
        one = robot.of(family)
        return _NONE if one is None else f"{one.median_kbps:.1f}"

    return _of_robot(f"{family}, kbit/s", text)


def _ms(value: float | None) -> str:
    return _NONE if value is None else f"{value:.0f}" if abs(value) >= 10 else f"{value:.1f}"


_GROUPS: Final[tuple[tuple[_Row, ...], ...]] = (
    (
        ("robot", lambda column: id_of(column.measurement.robot)),
        ("measured, s", lambda column: f"{column.seconds:.0f}"),
    ),
    (
        _of_robot("heartbeat latency p50, ms", lambda robot: _ms(getattr(robot.latency, "median_ms", None))),
        _of_robot("heartbeat latency p95, ms", lambda robot: _ms(getattr(robot.latency, "p95_ms", None))),
        _of_robot("heartbeat intervals", lambda robot: str(robot.intervals.count if robot.intervals else 0)),
        _of_robot("outages", lambda robot: str(len(robot.outages))),
        _of_robot("outage, median, ms", lambda robot: _outage(robot, median)),
        _of_robot("outage, longest, ms", lambda robot: _outage(robot, max)),
        _of_robot("offline, times", lambda robot: str(robot.offline or _NONE)),
    ),
    (("pictures a second", _rate), *_media("pictures", CAMERA.metric)),
    _media("sound", AUDIO.metric),
    tuple(map(_bandwidth, FAMILIES)),
)
