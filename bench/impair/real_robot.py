"""Measures a real robot behind the user's own network: requests its media, records it, and never drives it.

The table shows all measurements in a folder side by side, a column for each label, from their recordings.
"""

from __future__ import annotations

import re
import shutil
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack, closing, suppress
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any, Final

import msgspec
from rich import box
from rich.table import Table
from rich.text import Text

from pebble.bench.engine import check_folder
from pebble.bench.results import named
from pebble.client.connection import Target, connected, resolve
from pebble.client.names import ANY_ROBOT, id_of
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
from pebble.recordings.traffic.results import FAMILIES, Stream, Traffic
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
    seconds: float
    media: bool
    replace: bool

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


def measure(plan: Plan, progress: Progress) -> float:
    """Record the robot for the plan's time, or until KeyboardInterrupt; returns the seconds. Raises PebbleError.

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
            if plan.folder.exists():
                with named(plan.folder):
                    shutil.rmtree(plan.folder)
            check_folder(plan.folder)
            return _record(plan, viewer, progress)


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


def _require_heartbeat(transport: Transport, base: str) -> None:
    """Wait for a heartbeat of the robot. Raises PebbleError that names the robots that were received instead."""
    received: set[str] = set()

    def on_heartbeat(message: Message) -> None:
        address = parse_topic(message.topic)
        if address is not None and not message.retain:  # a retained heartbeat may be old
            received.add(address.identity.base)

    with closing(transport.subscribe(ONLINE.filter(ANY_ROBOT), on_heartbeat, qos=QoS.LATEST, direct=True)):
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


def _record(plan: Plan, viewer: Viewer, progress: Progress) -> float:
    kind, settings, _, _ = resolve(plan.target)
    settings = replace(settings, protocol="5") if kind == "mqtt" else settings
    recorder = _Recorder(plan, viewer)
    source = Source(recorder, kind, settings, [f"{viewer.base}/#"])

    def watch(seconds: float, what: str, is_over: Callable[[], bool]) -> None:
        began = checked = time.monotonic()
        while not is_over() and (now := time.monotonic()) - began < seconds:
            time.sleep(_TURN_S)
            if now - checked >= 1.0:
                checked = now
                source.check()
                viewer.repeat_requests()
            count = f"{recorder.counters['messages']:,} messages, {recorder.counters['bytes'] / 1e6:.1f} MB"
            problem = "" if source.connected else f", not connected: {source.problem or 'no answer'}"
            progress(f"{what}: {now - began:.0f} of {seconds:g} s, {count}{problem}")
            if recorder.blocked:
                raise PebbleError(f"{plan.folder}: {recorder.blocked}")

    with ExitStack() as stack:
        recorder.start()
        stack.callback(recorder.stop)
        stack.enter_context(closing(source)).start()
        measurement = Measurement(label=plan.label, robot=viewer.base, since_ns=recorder.clock.now())
        measurement.save(plan.folder)
        try:
            with suppress(KeyboardInterrupt):  # what was measured until then is the measurement
                requested = _request(viewer) if plan.media else []
                watch(_FIRST_S, "waiting for pictures and sound", lambda: recorder.arrived.issuperset(requested))
                measurement.since_ns = recorder.clock.now()
                watch(plan.seconds, "measuring", lambda: False)
        finally:
            measurement.until_ns = recorder.clock.now()
            measurement.save(plan.folder)
    return (measurement.until_ns - measurement.since_ns) / 1e9


def _request(viewer: Viewer) -> list[Medium]:
    """Requests all media that the robot offers."""
    sections = viewer.capabilities
    offered = [one for one in _MEDIA if sections.get(one, {}).get("available") and sections[one].get("controls")]
    for medium in offered:
        viewer.request(medium)
    return offered


# -- all measurements side by side


class Column(msgspec.Struct):
    """One measurement, analysed."""

    label: str
    rows: list[dict[str, str]]  # in groups
    remarks: list[str]


def columns(into: Path) -> list[Column]:
    """All measurements in a folder, the oldest first. Raises PebbleError, also if there is none."""
    require_packages("duckdb", "zstandard")
    found = [(_load(path), path.parent) for path in sorted(into.glob(f"*/{NAME}"))]
    if not found:
        raise PebbleError(f"{into}: there is no measurement of a real robot: see pebble impair --help")
    return [_column(one, folder) for one, folder in sorted(found, key=lambda pair: pair[0].since_ns)]


def _load(path: Path) -> Measurement:
    try:
        with named(path):
            return msgspec.json.decode(path.read_bytes(), type=Measurement)
    except msgspec.DecodeError as error:
        raise PebbleError(f"{path}: {error}") from None


def _column(one: Measurement, folder: Path) -> Column:
    with tempfile.TemporaryDirectory(prefix="pebble-impair-") as name:
        scratch = Path(name)
        try:
            found = sources([folder], scratch, robots=[one.robot], since_ns=one.since_ns, until_ns=one.until_ns)
            traffic = analyse(found, scratch, since_ns=one.since_ns, until_ns=one.until_ns)
        except RecordingError as error:  # no message arrived
            return Column(one.label, [_head(one, one.until_ns)], [str(error)])
    until_ns = traffic.until_ns if one.until_ns == FOREVER_NS else one.until_ns  # the program was killed
    return Column(one.label, [_head(one, until_ns), *_rows(traffic, until_ns - one.since_ns)], remarks(traffic))


def table(found: list[Column]) -> Table:
    """Rows are the figures of the paper, columns the labels; a row that would be empty is left out."""
    made = Table(box=box.SIMPLE_HEAD)
    made.add_column("", no_wrap=True)
    for column in found:
        made.add_column(Text(column.label), justify="right", no_wrap=True)
    for at in range(max(len(column.rows) for column in found)):
        groups = [column.rows[at] if at < len(column.rows) else {} for column in found]
        for name in dict.fromkeys(name for group in groups for name in group):
            cells = [group.get(name, _NONE) for group in groups]
            if any(cell != _NONE for cell in cells):
                made.add_row(name, *map(Text, cells))
        made.add_section()
    return made


def _head(one: Measurement, until_ns: int) -> dict[str, str]:
    seconds = 0.0 if until_ns == FOREVER_NS else (until_ns - one.since_ns) / 1e9
    return {"robot": id_of(one.robot), "measured, s": f"{seconds:.0f}"}


def _rows(traffic: Traffic, length_ns: int) -> list[dict[str, str]]:
    robot = traffic.robots[0]
    pictures, sound = ({one.metric: one for one in robot.streams}.get(channel.metric) for channel in (CAMERA, AUDIO))
    latency, outages = robot.latency, [one.length_ms for one in robot.outages]
    rate = _NONE if pictures is None or not length_ns else f"{1e9 * pictures.messages / length_ns:.1f}"
    bandwidths = {family: robot.of(family) for family in FAMILIES}
    return [
        {
            "heartbeat latency p50, ms": _ms(latency.median_ms if latency else None),
            "heartbeat latency p95, ms": _ms(latency.p95_ms if latency else None),
            "heartbeat intervals": str(robot.intervals.count if robot.intervals else 0),
            "outages": str(len(outages)),
            "outage, median, ms": _ms(median(outages) if outages else None),
            "outage, longest, ms": _ms(max(outages, default=None)),
            "offline, times": str(robot.offline or _NONE),
        },
        {"pictures a second": rate, **_stream("pictures", pictures)},
        _stream("sound", sound),
        {f"{family}, kbit/s": f"{one.median_kbps:.1f}" if one else _NONE for family, one in bandwidths.items()},
    ]


def _stream(name: str, stream: Stream | None) -> dict[str, str]:
    return {
        f"{name} lost": f"{stream.lost_share:.1%}" if stream else _NONE,
        f"{name}, jitter p50, ms": _ms(stream.jitter_median_ms if stream else None),
        f"{name}, jitter p95, ms": _ms(stream.jitter_p95_ms if stream else None),
    }


def _ms(value: float | None) -> str:
    return _NONE if value is None else f"{value:.0f}" if abs(value) >= 10 else f"{value:.1f}"
