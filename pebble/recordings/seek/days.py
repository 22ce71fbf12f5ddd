"""The days of an archive, and what each holds, by the summaries of its files."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from msgspec import Struct, field

from pebble.recordings.recorder.intake import EVENTS
from pebble.recordings.seek.archive import Archive
from pebble.recordings.seek.file import RecordingFile

DAY_NS: Final = 86_400 * 10**9


class Day(Struct):
    """One day of UTC; ``first`` and ``last`` in epoch milliseconds, ``gaps``: of the recording itself."""

    day: str
    robots: list[str] = field(default_factory=list)
    bytes: int = 0
    first: float = 0.0
    last: float = 0.0
    gaps: int = 0


class Days:
    """Remembers what was found of each file that does not change any more."""

    def __init__(self, archive: Archive) -> None:
        self._archive = archive
        self._known: dict[Path, list[Day]] = {}

    def all(self) -> list[Day]:
        """The newest first. A file counts to each day that its messages reach into; its bytes to the first."""
        found: dict[str, Day] = {}
        for file in self._archive.all_files():
            days = self._known.get(file.path)
            if days is None:
                days = _days(file)
                if file.is_finished:
                    self._known[file.path] = days
            for day in days:
                _merge(found.setdefault(day.day, Day(day.day, first=day.first)), day)
        return sorted(found.values(), key=lambda day: day.day, reverse=True)


def _days(file: RecordingFile) -> list[Day]:
    if not file.first_ns:
        return []
    gaps = _gaps(file)
    days: list[Day] = []
    for number in range(file.first_ns // DAY_NS, file.last_ns // DAY_NS + 1):
        begin, end = number * DAY_NS, (number + 1) * DAY_NS
        first, last = max(file.first_ns, begin), min(file.last_ns, end - 1)
        size = 0 if days else file.size()
        within = sum(begin <= ns < end for ns in gaps)
        name = datetime.fromtimestamp(number * 86_400, UTC).strftime("%Y-%m-%d")
        days.append(Day(name, sorted(file.robots()), size, first / 1e6, last / 1e6, within))
    return days


def _merge(day: Day, other: Day) -> None:
    day.robots = sorted({*day.robots, *other.robots})
    day.bytes += other.bytes
    day.first, day.last = min(day.first, other.first), max(day.last, other.last)
    day.gaps += other.gaps


def _gaps(file: RecordingFile) -> list[int]:
    """When the recorder wrote down gaps."""
    numbers = {number for number, channel in file.channels.items() if channel.topic == EVENTS}
    found = []
    for chunk in file.chunks if numbers else []:
        if not chunk.channels.isdisjoint(numbers):
            found += [one.log_ns for one in file.messages(chunk) if one.channel.id in numbers and _is_gap(one.payload)]
    return found


def _is_gap(payload: bytes) -> bool:
    try:
        event = json.loads(payload)
    except (ValueError, RecursionError):
        return False
    return isinstance(event, dict) and event.get("event") == "gap"
