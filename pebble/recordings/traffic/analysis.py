"""Analyses the traffic of recordings by their index, one robot after the other."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from msgspec import Struct

from pebble.recordings.files.recorded import RecordingError
from pebble.recordings.library import FOREVER_NS
from pebble.recordings.traffic.duck import connected, parquet
from pebble.recordings.traffic.queries import RobotQueries
from pebble.recordings.traffic.results import Gap, Outage, RobotTraffic, Traffic
from pebble.recordings.traffic.shared_outages import Presence, shared
from pebble.recordings.traffic.sources import Progress, Sources

_MEMORY_MB: Final = 192
_THREADS: Final = 2
_TICK_NS: Final = 200_000_000  # of the recorder's writer: it is late by what comes on top
_EVENTS: Final = """
    SELECT event, epoch_ns(ts), epoch_ns(since), epoch_ns(until), json_extract_string(json, '$.why'),
           coalesce(try_cast(json_extract_string(json, '$.messages') AS BIGINT), 0),
           coalesce(try_cast(json_extract_string(json, '$.max_ms') AS DOUBLE), 0)
    FROM {events} ORDER BY ts
"""


class RecorderEvents(Struct):
    """What recorders noted about themselves."""

    gaps: list[Gap]
    starts: list[int]  # ns; what was before is not known
    late: list[tuple[int, int]]  # ns
    dropped: int = 0

    def breaks(self) -> list[tuple[int, int]]:
        """Times that no heartbeat interval can be measured across."""
        return [*((gap.since_ns, gap.until_ns) for gap in self.gaps), *((ns, ns) for ns in self.starts)]

    def was_late(self, outage: Outage, usual_ms: float) -> bool:
        until_ns = outage.since_ns + round((outage.length_ms + usual_ms) * 1e6)
        return any(since < until_ns and until > outage.since_ns for since, until in self.late)


def analyse(
    sources: Sources,
    scratch: Path,
    *,
    since_ns: int = 0,
    until_ns: int = FOREVER_NS,
    overhead: bool = False,
    progress: Progress = lambda _what, _share: None,
) -> Traffic:
    """The traffic from ``since_ns`` to before ``until_ns``.

    ``overhead``: bandwidths with topics and the headers of MQTT and TCP/IP, else of payloads. Files that do not fit
    into memory are made below ``scratch``. Raises RecordingError, also if there is no message.
    """
    with connected(scratch, memory_mb=_MEMORY_MB, threads=_THREADS) as connection:
        recorder = recorder_events(connection, sources.events, since_ns, until_ns)
        robots, presences, spans = [], [], []
        for number, (name, parts) in enumerate(sorted(sources.parts.items())):
            progress(name, number / len(sources.parts))
            queries = RobotQueries(connection, name, overhead=overhead)
            queries.load(parts, since_ns, until_ns)
            messages, size, first_ns, last_ns = queries.totals()
            if messages:
                spans += [first_ns, last_ns]
                robots.append(_robot(queries, name, messages, size))
                presences.append(_presence(robots[-1], queries.online()))
        progress("", 1.0)
    if not robots:
        raise RecordingError("there is no message of a robot in this period: see pebble recordings list")
    _mark(robots, presences, recorder)
    return Traffic(
        since_ns=min(spans), until_ns=max(spans), recordings=sources.recordings, missing=sources.missing,
        dropped=recorder.dropped, gaps=recorder.gaps, robots=robots, overhead=overhead,
        unread=sources.unread,
    )  # fmt: skip


def _robot(queries: RobotQueries, name: str, messages: int, size: int) -> RobotTraffic:
    intervals = queries.intervals()
    session_s, idle_s = queries.durations()
    offline, offline_s = queries.offline()
    return RobotTraffic(
        robot=name, machine=queries.machine, messages=messages, bytes=size, session_s=session_s, idle_s=idle_s,
        offline=offline, offline_s=offline_s, bandwidth=queries.bandwidth(), sessions=queries.sessions(),
        intervals=intervals, outages=[] if intervals is None else queries.outages(intervals.median_ms),
        latency=queries.latency(), streams=queries.streams(),
    )  # fmt: skip


def _presence(robot: RobotTraffic, online: Sequence[tuple[int, int]]) -> Presence:
    usual_ms = 0.0 if robot.intervals is None else robot.intervals.median_ms
    spans = [(since * 10**9, until * 10**9) for since, until in online]
    return Presence(usual_ms * 1e6, spans, [outage.since_ns for outage in robot.outages])


def _mark(robots: Sequence[RobotTraffic], presences: Sequence[Presence], recorder: RecorderEvents) -> None:
    for robot, marks in zip(robots, shared(presences), strict=True):
        usual_ms = 0.0 if robot.intervals is None else robot.intervals.median_ms
        for outage, is_shared in zip(robot.outages, marks, strict=True):
            outage.shared = is_shared
            outage.recorder_late = recorder.was_late(outage, usual_ms)


def recorder_events(connection: Any, events: Sequence[Path], since_ns: int, until_ns: int) -> RecorderEvents:
    """What recorders noted in a period; makes the table ``breaks`` that `RobotQueries` needs."""
    found = RecorderEvents([], [], [])
    rows = connection.execute(_EVENTS.format(events=parquet(events))).fetchall() if events else []
    for event, ns, since, until, why, messages, late_ms in rows:
        if event == "gap" and since is not None and until is not None and since < until_ns and until >= since_ns:
            found.gaps.append(Gap(since, until, why or ""))
            found.dropped += messages
        elif event in ("start", "clock"):
            found.starts.append(ns)
        elif event == "late":
            found.late.append((ns - round(late_ms * 1e6) - _TICK_NS, ns))
        elif event == "dropped" and since_ns <= ns < until_ns:
            found.dropped += messages
    connection.execute("CREATE TEMP TABLE breaks (since_ns BIGINT, until_ns BIGINT)")
    for one in found.breaks():
        connection.execute("INSERT INTO breaks VALUES (?, ?)", one)
    return found
