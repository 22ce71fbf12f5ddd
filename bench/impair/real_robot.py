"""Measures a real robot behind the user's own network: requests its media, records it, and never drives it.

The table shows all measurements in a folder side by side, a column for each label, from their recordings.
"""

from __future__ import annotations

import re
import shutil
import tempfile
import threading
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
from pebble.client.names import id_of
from pebble.client.viewer import Medium, Viewer
from pebble.contract import AUDIO, CAMERA, ONLINE
from pebble.errors import PebbleError
from pebble.recordings.files.reader import RecordingError
from pebble.recordings.library import FOREVER_NS
from pebble.recordings.recorder.recorder import Options, Recorder
from pebble.recordings.recorder.source import Source
from pebble.recordings.traffic.analysis import analyse
from pebble.recordings.traffic.duck import require_packages
from pebble.recordings.traffic.report import remarks as remarks_of
from pebble.recordings.traffic.results import FAMILIES, Traffic
from pebble.recordings.traffic.sources import sources
from pebble.transports import Message, QoS, Transport

NAME: Final = "impair.json"
_LABEL: Final = re.compile(r"(?!\d+$)[A-Za-z0-9][A-Za-z0-9._+%-]{0,63}")  # a recorder's own folders are digits
_HEARTBEAT_S: Final = 5.0
_CAPABILITIES_S: Final = 5.0
_FIRST_S: Final = 15.0  # a camera that is off takes a moment to open
_TURN_S: Final = 0.1
_MEDIA: Final[tuple[Medium, ...]] = ("video", "audio")


class Measurement(msgspec.Struct):
    """What was measured, beside its recordings; times in nanoseconds since 1970."""

    robot: str  # its base topic
    since_ns: int
    until_ns: int = FOREVER_NS  # unless it was completed

    def save(self, folder: Path) -> None:
        (folder / NAME).write_bytes(msgspec.json.encode(self))


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


def measure(plan: Plan, progress: Callable[[str], None]) -> float:
    """Records the robot for so long, or until KeyboardInterrupt; returns the seconds. Raises PebbleError.

    Nothing is measured before all requested media have arrived, for at most 15 s. At the end the requests are
    withdrawn.
    """
    _check(plan)
    with connected(plan.target) as (transport, names), closing(Viewer(transport, names.base, None)) as viewer:
        _wait_for_heartbeat(transport, names.base)
        if plan.media:
            viewer.wait_for_capabilities(_CAPABILITIES_S)
        if plan.folder.exists():
            with named(plan.folder):
                shutil.rmtree(plan.folder)
        check_folder(plan.folder)
        return _record(plan, viewer, progress)


def _check(plan: Plan) -> None:
    if not _LABEL.fullmatch(plan.label):
        raise PebbleError(f'--label "{plan.label}" cannot name a folder: use letters, digits and . _ + % -')
    require_packages("duckdb", "zstandard")
    if plan.folder.exists() and not plan.replace:
        raise PebbleError(f"{plan.folder} exists: add --replace to measure it again, or use another --label")
    if plan.folder.exists() and not (plan.folder / NAME).is_file():
        raise PebbleError(f"{plan.folder} is no measurement, so it is not replaced: use another --label or --into")


def _wait_for_heartbeat(transport: Transport, base: str) -> None:
    """Raises PebbleError without one."""
    came = threading.Event()

    def on_heartbeat(message: Message) -> None:
        if not message.retain:  # else it may be old
            came.set()

    with closing(transport.subscribe(ONLINE.topic(base), on_heartbeat, qos=QoS.LATEST, direct=True)):
        if not came.wait(_HEARTBEAT_S):
            raise PebbleError(f"no heartbeat of {id_of(base)} came within {_HEARTBEAT_S:g} s: is this its broker?")


class _Recorder(Recorder):
    """A recorder that notes for a viewer which media have arrived."""

    def __init__(self, plan: Plan, viewer: Viewer) -> None:
        super().__init__(plan.folder, Options(), {"impair": plan.label, "filters": f"{viewer.base}/#"})
        self.arrived: set[Medium] = set()
        self._viewer = viewer
        self._media = {viewer.capabilities.get(medium, {}).get("topic"): medium for medium in _MEDIA}

    def receive(self, topic: str, payload: bytes, *about: Any, retained: bool = False, **more: Any) -> None:
        medium = self._media.get(topic)
        if medium is not None and not retained:
            self.arrived.add(medium)
            self._viewer.note_received(medium)
        super().receive(topic, payload, *about, retained=retained, **more)


def _record(plan: Plan, viewer: Viewer, progress: Callable[[str], None]) -> float:
    kind, settings, _, _ = resolve(plan.target)
    settings = replace(settings, protocol="5") if kind == "mqtt" else settings
    recorder, requested = _Recorder(plan, viewer), set[Medium]()
    source = Source(recorder, kind, settings, [f"{viewer.base}/#"])

    def watch(seconds: float, what: str, is_over: Callable[[], bool]) -> None:
        began = checked = time.monotonic()
        while not is_over() and (now := time.monotonic()) - began < seconds:
            time.sleep(_TURN_S)
            if now - checked >= 1.0:
                checked = now
                source.check()
                viewer.repeat_requests()
            problem = "" if source.connected else f", not connected: {source.problem or 'no answer'}"
            count = f"{recorder.counters['messages']:,} messages"
            progress(f"{what}: {now - began:.0f} of {seconds:g} s, {count}{problem}")
            if recorder.blocked:
                raise PebbleError(f"{plan.folder}: {recorder.blocked}")

    with ExitStack() as stack:
        recorder.start()
        stack.callback(recorder.stop)
        stack.enter_context(closing(source)).start()
        measurement = Measurement(viewer.base, recorder.clock.now())
        measurement.save(plan.folder)
        with suppress(KeyboardInterrupt):  # what was measured until then is the measurement
            for medium in _MEDIA if plan.media else ():
                with suppress(PebbleError):  # the robot does not offer it
                    viewer.request(medium)
                    requested.add(medium)
            watch(_FIRST_S, "waiting for pictures and sound", lambda: recorder.arrived >= requested)
            measurement.since_ns = recorder.clock.now()
            watch(plan.seconds, "measuring", lambda: False)
        measurement.until_ns = recorder.clock.now()
        measurement.save(plan.folder)
    return (measurement.until_ns - measurement.since_ns) / 1e9


# -- all measurements side by side


def compared(into: Path) -> tuple[Table, list[str]]:
    """All measurements in a folder, the oldest first, and what stands out. Raises PebbleError, also if there is none.

    Rows are the figures of the paper, columns the labels; a row that would be empty is left out.
    """
    require_packages("duckdb", "zstandard")
    found = {path.parent: msgspec.json.decode(path.read_bytes(), type=Measurement) for path in into.glob(f"*/{NAME}")}
    if not found:
        raise PebbleError(f"{into}: there is no measurement of a real robot: see pebble impair --help")
    table, notes, columns = Table("", box=box.SIMPLE_HEAD), list[str](), list[dict[str, str]]()
    for folder, one in sorted(found.items(), key=lambda pair: pair[1].since_ns):
        rows, remarks = _analysed(folder, one)
        columns.append(rows)
        notes += [f"{folder.name}: {remark}" for remark in remarks]
        table.add_column(Text(folder.name), justify="right", no_wrap=True)
    for name in dict.fromkeys(name for rows in columns for name in rows):
        table.add_row(Text(name), *(Text(rows.get(name, "–")) for rows in columns))
    return table, notes


def _analysed(folder: Path, one: Measurement) -> tuple[dict[str, str], list[str]]:
    """The rows of the table, and remarks."""
    about, since_ns, until_ns = {"robot": id_of(one.robot)}, one.since_ns, one.until_ns
    with tempfile.TemporaryDirectory(prefix="pebble-impair-") as name:
        scratch = Path(name)
        try:
            found = sources([folder], scratch, robots=[one.robot], since_ns=since_ns, until_ns=until_ns)
            traffic = analyse(found, scratch, since_ns=since_ns, until_ns=until_ns)
        except RecordingError as error:  # no message arrived
            return about, [str(error)]
    ended_ns = traffic.until_ns if until_ns == FOREVER_NS else until_ns  # forever: the program was killed
    return about | _rows(traffic, (ended_ns - since_ns) / 1e9), remarks_of(traffic)


def _rows(traffic: Traffic, seconds: float) -> dict[str, str]:
    robot = traffic.robots[0]
    streams = {one.metric: one for one in robot.streams}
    latency, outages = robot.latency, [one.length_ms for one in robot.outages]
    rows: dict[str, float | None] = {
        "measured, s": round(seconds),
        "heartbeat latency p50, ms": latency.median_ms if latency else None,
        "heartbeat latency p95, ms": latency.p95_ms if latency else None,
        "heartbeat intervals": robot.intervals.count if robot.intervals else 0,
        "outages": len(outages),
        "outage, median, ms": median(outages) if outages else None,
        "outage, longest, ms": max(outages, default=None),
        "offline, times": robot.offline,
    }
    for what, channel in (("pictures", CAMERA), ("sound", AUDIO)):
        if stream := streams.get(channel.metric):
            rows[f"{what} a second"] = stream.messages / seconds if seconds else None
            rows[f"{what} lost, %"] = 100 * stream.lost_share
            rows[f"{what}, jitter p50, ms"] = stream.jitter_median_ms
            rows[f"{what}, jitter p95, ms"] = stream.jitter_p95_ms
    rows |= {f"{family}, kbit/s": one.median_kbps for family in FAMILIES if (one := robot.of(family))}
    return {name: _shown(value) for name, value in rows.items() if value is not None}


def _shown(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:.0f}" if abs(value) >= 10 else f"{value:.1f}"
