"""The tables of an analysis, for its report and as CSV files. Times are UTC."""

import csv
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from typing import Any

from msgspec import Struct

from pebble.recordings.traffic.results import AUDIO, VIDEO, RobotTraffic, Traffic

BRIEF_MS = 300.0  # most outages of the paper are shorter


class Table(Struct, frozen=True):
    """``columns``: the name of each in CSV, and its heading."""

    name: str
    title: str
    columns: Sequence[tuple[str, str]]
    rows: Sequence[Sequence[Any]]


def tables(traffic: Traffic) -> list[Table]:
    """All tables; those of media and gaps may have no rows."""
    makers = (media_bandwidth, _bandwidth, _sessions, _heartbeats, _latency, _streams, _outages, _gaps)
    return [make(traffic) for make in makers]


def media_bandwidth(traffic: Traffic) -> Table:
    """Table 4.1 of the paper."""
    columns = [
        ("robot", "robot"), ("video_median_kbps", "video, median kbit/s"), ("video_p95_kbps", "video, p95"),
        ("audio_median_kbps", "audio, median kbit/s"), ("audio_p95_kbps", "audio, p95"),
    ]  # fmt: skip
    rows = []
    for robot in traffic.robots:
        both = robot.of(VIDEO), robot.of(AUDIO)
        if any(both):
            cells = [(None, None) if one is None else (one.median_kbps, one.p95_kbps) for one in both]
            rows.append([robot.robot, *cells[0], *cells[1]])
    return Table("table-4-1-media-bandwidth", "Table 4.1: bandwidth of media, of active seconds", columns, rows)


def _bandwidth(traffic: Traffic) -> Table:
    columns = [
        ("robot", "robot"), ("machine", "machine"), ("family", "kind of message"), ("time", "time"),
        ("active_seconds", "active seconds"), ("median_kbps", "median kbit/s"), ("p95_kbps", "p95 kbit/s"),
        ("messages", "messages"), ("bytes", "bytes"),
    ]  # fmt: skip
    rows = [
        [
            robot.robot, robot.machine, one.family, one.time, one.seconds, one.median_kbps, one.p95_kbps, one.messages,
            one.bytes,
        ]
        for robot in traffic.robots
        for one in robot.bandwidth
    ]  # fmt: skip
    return Table("bandwidth", "Bandwidth", columns, rows)


def _sessions(traffic: Traffic) -> Table:
    columns = [
        ("robot", "robot"), ("since", "from"), ("until", "until"), ("seconds", "seconds"),
        ("activities", "what happened"),
    ]  # fmt: skip
    rows = [
        [robot.robot, moment(one.since_s), moment(one.until_s), one.length_s, ", ".join(one.activities)]
        for robot in traffic.robots
        for one in robot.sessions
    ]
    return Table("sessions", "Sessions", columns, rows)


def _heartbeats(traffic: Traffic) -> Table:
    columns = [
        ("robot", "robot"), ("intervals", "intervals"), ("interval_median_ms", "median ms"),
        ("interval_p95_ms", "p95 ms"), ("interval_p99_ms", "p99 ms"), ("outages", "outages"),
        ("outage_median_ms", "outage, median ms"), ("outage_longest_ms", "longest ms"),
        ("outages_below_300_ms", "below 300 ms"), ("outages_shared", "shared"),
        ("outages_recorder_late", "recorder late"), ("offline", "offline, times"), ("offline_s", "offline, seconds"),
    ]  # fmt: skip
    return Table("heartbeats", "Heartbeats and outages", columns, list(_heartbeat_rows(traffic.robots)))


def _heartbeat_rows(robots: Sequence[RobotTraffic]) -> Iterator[list[Any]]:
    for robot in robots:
        usual = robot.intervals
        if usual is None:
            continue
        lengths = [one.length_ms for one in robot.outages]
        causes = [one.cause for one in robot.outages]
        yield [
            robot.robot, usual.count, usual.median_ms, usual.p95_ms, usual.p99_ms, len(lengths),
            median(lengths) if lengths else None, max(lengths, default=None), sum(one < BRIEF_MS for one in lengths),
            causes.count("shared"), causes.count("recorder"), robot.offline, robot.offline_s,
        ]  # fmt: skip


def _latency(traffic: Traffic) -> Table:
    columns = [
        ("robot", "robot"), ("heartbeats", "heartbeats"), ("floor_ms", "floor (p1) ms"), ("median_ms", "median ms"),
        ("p95_ms", "p95 ms"), ("p99_ms", "p99 ms"), ("whole_second_share", "whole-second stamps"), ("note", "note"),
    ]  # fmt: skip
    rows = [
        [
            robot.robot, one.count, one.floor_ms, one.median_ms, one.p95_ms, one.p99_ms, one.whole_share,
            latency_note(robot),
        ]
        for robot in traffic.robots
        if (one := robot.latency) is not None
    ]  # fmt: skip
    return Table("latency", "Latency of heartbeats", columns, rows)


def latency_note(robot: RobotTraffic) -> str:
    """What a reader must know about the latencies of a robot; may be empty."""
    latency, notes = robot.latency, []
    if latency is not None and latency.whole_seconds:
        notes.append("whole-second stamps: 0 to 1000 ms of this is the stamp's, not the network's")
    if latency is not None and latency.ahead_ms:
        notes.append(f"the robot's clock is at least {latency.ahead_ms:.0f} ms ahead")
    return "; ".join(notes)


def _streams(traffic: Traffic) -> Table:
    columns = [
        ("robot", "robot"), ("metric", "topic"), ("encodings", "encodings"), ("messages", "messages"), ("lost", "lost"),
        ("lost_share", "share lost"), ("restarts", "restarts"), ("jitter_median_ms", "jitter, median ms"),
        ("jitter_p95_ms", "p95 ms"),
    ]  # fmt: skip
    rows = [
        [
            robot.robot, one.metric, ", ".join(one.encodings), one.messages, one.lost, one.lost_share, one.restarts,
            one.jitter_median_ms, one.jitter_p95_ms,
        ]
        for robot in traffic.robots
        for one in robot.streams
    ]  # fmt: skip
    return Table("media", "Loss and jitter of media", columns, rows)


def _outages(traffic: Traffic) -> Table:
    columns = [("robot", "robot"), ("since", "from"), ("length_ms", "length ms"), ("cause", "cause")]
    rows = [
        [robot.robot, moment(one.since_ns / 1e9), one.length_ms, one.cause]
        for robot in traffic.robots
        for one in robot.outages
    ]
    return Table("outages", "Outages", columns, rows)


def _gaps(traffic: Traffic) -> Table:
    columns = [("since", "from"), ("until", "until"), ("why", "why")]
    rows = [[moment(one.since_ns / 1e9), moment(one.until_ns / 1e9), one.why] for one in traffic.gaps]
    return Table("recording-gaps", "Times in which nothing was recorded", columns, rows)


def moment(seconds: float) -> str:
    """``2026-11-20T10:00:00Z``; with milliseconds if it is no whole second."""
    spec = "seconds" if seconds == int(seconds) else "milliseconds"
    return datetime.fromtimestamp(seconds, UTC).replace(tzinfo=None).isoformat(timespec=spec) + "Z"


def write_csv(table: Table, folder: Path) -> Path:
    """Raises OSError."""
    path = folder / f"{table.name}.csv"
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([name for name, _ in table.columns])
        writer.writerows([_cell(value) for value in row] for row in table.rows)
    return path


def _cell(value: Any) -> Any:
    """Spreadsheets take text for a formula that begins like one; anyone may choose the names in topics."""
    return f"'{value}" if isinstance(value, str) and value.startswith(("=", "+", "-", "@", "\t", "\r")) else value
