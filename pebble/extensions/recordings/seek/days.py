"""The days of an archive with their contents, from the summaries of its files."""

from collections.abc import Iterator
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from msgspec import Struct, field

from pebble.contract import DRIVE
from pebble.extensions.recordings.catalogue import event_in
from pebble.extensions.recordings.files.reader import Chunk, RecordingFile
from pebble.extensions.recordings.files.recorded import FOREVER_NS
from pebble.extensions.recordings.library import robot_of, robots_of
from pebble.extensions.recordings.recorder.intake import EVENTS
from pebble.extensions.recordings.seek.archive import Archive, messages_of

DAY_NS: Final = 86_400 * 10**9
_MOST_DAYS: Final = 31  # of one chunk


class Day(Struct):
    """A day (UTC). ``first``, ``last``: epoch milliseconds. ``gaps``: times that were not recorded.

    ``driven``: the seconds in which a robot was sent drive commands, by robot. A chunk with a command counts in full.
    ``unread``: a line for each file that cannot be read completely, on the day of its last change.
    """

    day: str
    robots: list[str] = field(default_factory=list)
    bytes: int = 0
    first: float = 0.0
    last: float = 0.0
    gaps: int = 0
    driven: dict[str, float] = field(default_factory=dict)
    unread: list[str] = field(default_factory=list)


class Days:
    """The table of days. It remembers the contents of files that no longer change."""

    def __init__(self, archive: Archive) -> None:
        self._archive = archive
        self._known: dict[Path, list[Day]] = {}

    def all(self) -> list[Day]:
        """Return the days, newest first.

        A file counts for each day on which it has messages; its bytes count for the first.
        """
        by_name: dict[str, Day] = {}
        for file in self._archive.all_files():
            days = self._known.get(file.path)
            if days is None:
                days = _days(file)
                if file.damage.finished:
                    self._known[file.path] = days
            for day in days:
                _merge(by_name.setdefault(day.day, Day(day.day, first=day.first)), day)
        for path, why in self._archive.unread().items():
            with suppress(OSError):  # it is deleted by now
                about = path.stat()
                name, ms = _day_of(int(about.st_mtime)), about.st_mtime * 1e3
                # A day that has no other file gets the size and the time of this one.
                day = by_name.setdefault(name, Day(name, bytes=about.st_size, first=ms, last=ms))
                day.unread.append(f"{path.name}: {why}")
        return sorted(by_name.values(), key=lambda day: day.day, reverse=True)


def _days(file: RecordingFile) -> list[Day]:
    if not file.chunks:
        return []
    gaps = _gaps(file)
    robots = sorted(robots_of(file.channels.values()))
    days: list[Day] = []
    for number in sorted({number for chunk in file.chunks for number in _day_numbers(chunk)}):
        begin, end = number * DAY_NS, (number + 1) * DAY_NS
        first, last = max(file.first_ns, begin), min(file.last_ns, end - 1)
        size = 0 if days else file.size  # the first day has all bytes
        gaps_within = sum(begin <= ns < end for ns in gaps)
        driven = _driven(file, begin, end)
        days.append(Day(_day_of(number * 86_400), robots, size, first / 1e6, last / 1e6, gaps_within, driven))
    return days


def _driven(file: RecordingFile, begin: int, end: int) -> dict[str, float]:
    """Return the driven seconds within a day, by robot; a chunk with a drive command counts in full."""
    robots: dict[int, str] = {}  # by the number of a channel with drive commands
    for number, channel in file.channels.items():
        robot = robot_of(channel.topic)
        if robot is not None and channel.topic.rpartition("/")[2] == DRIVE.metric:
            robots[number] = robot
    seconds: dict[str, float] = {}
    for chunk in file.chunks if robots else []:
        within_s = max(0, min(chunk.end_ns, end) - max(chunk.start_ns, begin)) / 1e9
        if within_s:
            for robot in {robots[number] for number in chunk.channels & robots.keys()}:
                seconds[robot] = seconds.get(robot, 0.0) + within_s
    return seconds


def _day_of(seconds: int) -> str:
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d")


def _day_numbers(chunk: Chunk) -> Iterator[int]:
    """Yield the days of a chunk.

    If they are too many, as after a change of the clock, only the first ones and the last.
    """
    first, last = chunk.start_ns // DAY_NS, chunk.end_ns // DAY_NS
    yield from range(first, min(last, first + _MOST_DAYS))
    yield last


def _merge(day: Day, other: Day) -> None:
    day.robots = sorted({*day.robots, *other.robots})
    day.bytes += other.bytes
    day.first, day.last = min(day.first, other.first), max(day.last, other.last)
    day.gaps += other.gaps
    for robot, seconds in other.driven.items():
        day.driven[robot] = day.driven.get(robot, 0.0) + seconds


def _gaps(file: RecordingFile) -> list[int]:
    """Return the times of the gaps that the recorder noted."""
    numbers = frozenset(number for number, channel in file.channels.items() if channel.topic == EVENTS)
    if not numbers:
        return []
    noted = messages_of(file, numbers, 0, FOREVER_NS)
    return [message.log_ns for message in noted if event_in(message.payload).get("event") == "gap"]
