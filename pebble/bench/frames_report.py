"""Figures of a comparison of frames: rounds become rows, rows become JSON, a table and ratios. Pure."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any

from rich import box
from rich.table import Table

from pebble.bench.figures import percentile, ratio, rounded
from pebble.bench.frames_variants import ABOUT, VARIANTS, Case


@dataclass(frozen=True, slots=True, kw_only=True)
class Round:
    """What one run of one case measured; CPU in % of one core, memory (PSS) in MB. Readers: the mean of them."""

    latencies_us: Sequence[float]  # of all readers
    sent: int
    torn: int
    fallbacks: int  # frames that did not go through shared memory, since the start
    cpu_writer: float
    cpu_reader: float
    cpu_broker: float | None
    memory_writer_mb: float
    memory_reader_mb: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """A case over all its rounds: medians of the rounds' figures, except ``n`` (sum) and ``max_us`` (the worst)."""

    case: Case
    n: int
    p50_us: float
    p99_us: float
    max_us: float
    cpu_writer: float
    cpu_reader: float
    more: dict[str, float | int | None] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        return {
            "variant": self.case.variant,
            "params": {"size": str(self.case.size), "readers": self.case.readers},
            "n": self.n,
            **{name: rounded(getattr(self, name), 1) for name in ("p50_us", "p99_us", "max_us")},
            **{name: rounded(getattr(self, name), 2) for name in ("cpu_writer", "cpu_reader")},
            **{name: rounded(value, 2) for name, value in self.more.items()},
        }


def row_of(case: Case, rounds: Sequence[Round]) -> Row:
    """``rounds`` must not be empty; rounds in which nothing arrived count only as lost frames."""
    heard = [one for one in rounds if one.latencies_us]
    brokers = [one.cpu_broker for one in rounds if one.cpu_broker is not None]
    expected = sum(one.sent for one in rounds) * case.readers
    arrived = sum(len(one.latencies_us) for one in rounds)
    return Row(
        case=case,
        n=arrived,
        p50_us=_median([percentile(one.latencies_us, 50) for one in heard]),
        p99_us=_median([percentile(one.latencies_us, 99) for one in heard]),
        max_us=max((max(one.latencies_us) for one in heard), default=math.nan),
        cpu_writer=_median([one.cpu_writer for one in rounds]),
        cpu_reader=_median([one.cpu_reader for one in rounds]),
        more={
            "cpu_broker": _median(brokers) if brokers else None,
            "memory_writer_mb": _median([one.memory_writer_mb for one in rounds]),
            "memory_reader_mb": _median([one.memory_reader_mb for one in rounds]),
            "lost_percent": max(0.0, 100 * (1 - arrived / expected)) if expected else None,
            "torn": sum(one.torn for one in rounds),
            "fallbacks": sum(one.fallbacks for one in rounds),
            "rounds": len(rounds),
        },
    )


def as_json(rows: Sequence[Row]) -> dict[str, Any]:
    return {"rows": [row.as_json() for row in rows]}


def ratios(rows: Sequence[Row]) -> list[str]:
    """zenoh-shm against GStreamer and a bare copy, one line per size and number of readers."""
    by_case = {(row.case.variant, row.case.size, row.case.readers): row for row in rows}
    lines = []
    for row in rows:
        if row.case.variant != "zenoh-shm":
            continue
        for other in ("gstreamer-shm", "zenoh-copy", "mqtt"):
            against = by_case.get((other, row.case.size, row.case.readers))
            if against is not None:
                latency, cpu = ratio(row.p50_us, against.p50_us), ratio(row.cpu_reader, against.cpu_reader)
                what = f"{row.case.size}, readers: {row.case.readers}"
                lines.append(f"zenoh-shm / {other}, {what}: p50 {latency}, reader's CPU {cpu}")
    return lines


def tables(rows: Sequence[Row]) -> Iterator[Table]:
    """One table for each size and number of readers."""
    for key, some in groupby(sorted(rows, key=_order), key=lambda row: _order(row)[:2]):
        group = list(some)
        who = "one reader" if key[1] == 1 else f"{key[1]} readers"
        title = f"{group[0].case.size} BGR at 30 Hz, {who}"
        figures = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
        figures.add_column("variant", no_wrap=True)
        for name in ("p50 µs", "p99 µs", "max µs", "CPU %", "PSS MB", "lost %", "n"):
            figures.add_column(name, justify="right", no_wrap=True)
        for row in group:
            figures.add_row(row.case.variant, *_cells(row))
        yield figures


def _order(row: Row) -> tuple[int, int, int]:
    return row.case.size.bytes, row.case.readers, VARIANTS.index(row.case.variant)


def legend(variants: Sequence[str]) -> list[str]:
    return [
        *(f"{variant}: {ABOUT[variant]}" for variant in variants),
        "µs: from “frame complete in the writer” to “numpy array in the reader”.",
        "CPU %: of one core, writer / each reader / broker. PSS: writer / each reader.",
    ]


def _cells(row: Row) -> list[str]:
    broker, lost = row.more["cpu_broker"], row.more["lost_percent"]
    times = [f"{figure:,.0f}" for figure in (row.p50_us, row.p99_us, row.max_us)]
    if row.case.variant == "memcpy":
        return [*times, f"{row.cpu_reader:.1f}", "", "", str(row.n)]
    cpu = [row.cpu_writer, row.cpu_reader, *([] if broker is None else [broker])]
    memory = [row.more["memory_writer_mb"], row.more["memory_reader_mb"]]
    return [
        *times,
        " / ".join(f"{figure:.1f}" for figure in cpu),
        " / ".join(f"{figure:.0f}" for figure in memory),
        "" if lost is None else f"{lost:.1f}",
        str(row.n),
    ]


def _median(figures: Sequence[float]) -> float:
    return statistics.median(figures) if figures else math.nan
