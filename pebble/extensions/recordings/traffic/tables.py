"""The tables of an analysis, for its report and for CSV files. Times are UTC."""

import csv
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from msgspec import Struct

from pebble.extensions.recordings.traffic.results import AUDIO, VIDEO, Bandwidth, Traffic


class Table(Struct, frozen=True):
    """A table. ``columns``: the name of each column in CSV, and its heading."""

    name: str
    title: str
    columns: Sequence[tuple[str, str]]
    rows: Sequence[Sequence[Any]]


def tables(traffic: Traffic) -> list[Table]:
    """Return Table 4.1 of the paper, and the data of the figures; each may be empty."""
    return [make(traffic) for make in (media_bandwidth, _bandwidth, _outages, _latency)]


def media_bandwidth(traffic: Traffic) -> Table:
    """Return table 4.1 of the paper."""
    columns = [
        ("robot", "robot"), ("video_median_kbps", "video, median kbit/s"), ("video_p95_kbps", "video, p95"),
        ("audio_median_kbps", "audio, median kbit/s"), ("audio_p95_kbps", "audio, p95"),
    ]  # fmt: skip
    rows = []
    for robot in traffic.robots:
        video, audio = robot.of(VIDEO), robot.of(AUDIO)
        if video is not None or audio is not None:
            rows.append([robot.robot, *_median_and_p95(video), *_median_and_p95(audio)])
    return Table("table-4-1-media-bandwidth", "Table 4.1: bandwidth of media, of active seconds", columns, rows)


def _median_and_p95(bandwidth: Bandwidth | None) -> tuple[float | None, float | None]:
    return (None, None) if bandwidth is None else (bandwidth.median_kbps, bandwidth.p95_kbps)


def _bandwidth(traffic: Traffic) -> Table:
    columns = [
        ("robot", "robot"), ("machine", "machine"), ("family", "kind of message"), ("time", "time"),
        ("active_seconds", "active seconds"), ("median_kbps", "median kbit/s"), ("p95_kbps", "p95 kbit/s"),
        ("messages", "messages"), ("bytes", "bytes"),
    ]  # fmt: skip
    rows = [
        [
            robot.robot, robot.machine, row.family, row.time, row.seconds, row.median_kbps, row.p95_kbps, row.messages,
            row.bytes,
        ]
        for robot in traffic.robots
        for row in robot.bandwidth
    ]  # fmt: skip
    return Table("bandwidth", "Figure 4.3: bandwidth in sessions and while idle", columns, rows)


def _latency(traffic: Traffic) -> Table:
    columns = [
        ("robot", "robot"), ("heartbeats", "heartbeats"), ("median_ms", "median ms"), ("p95_ms", "p95 ms"),
    ]  # fmt: skip
    rows = [
        [robot.robot, latency.count, latency.median_ms, latency.p95_ms]
        for robot in traffic.robots
        if (latency := robot.latency) is not None
    ]
    return Table("latency", "Figures 4.2, 4.5 and 4.6: latency of heartbeats", columns, rows)


def _outages(traffic: Traffic) -> Table:
    columns = [("robot", "robot"), ("since", "from"), ("length_ms", "length ms")]
    rows = [
        [robot.robot, moment(gap.since_ns / 1e9), gap.length_ms] for robot in traffic.robots for gap in robot.outages
    ]
    return Table("outages", "Figures 4.1 and 4.4: outages of heartbeats", columns, rows)


def moment(seconds: float) -> str:
    """Return a time as ``2026-11-20T10:00:00Z``, with milliseconds unless it is a whole second."""
    spec = "seconds" if seconds == int(seconds) else "milliseconds"
    return datetime.fromtimestamp(seconds, UTC).replace(tzinfo=None).isoformat(timespec=spec) + "Z"


def write_csv(table: Table, folder: Path) -> Path:
    """Write a table as CSV. Raises OSError."""
    path = folder / f"{table.name}.csv"
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([name for name, _ in table.columns])
        writer.writerows([_cell(value) for value in row] for row in table.rows)
    return path


def _cell(value: Any) -> Any:
    """Return a cell that no spreadsheet takes for a formula: names in topics come from anybody."""
    return f"'{value}" if isinstance(value, str) and value.startswith(("=", "+", "-", "@", "\t", "\r")) else value
