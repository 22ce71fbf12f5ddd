"""Recordings as one stream of messages in the order of time, however many files they are in."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from pebble.recordings.files.mcap import MAGIC, Channel, Recorded
from pebble.recordings.files.reader import SUFFIX as SUFFIX
from pebble.recordings.files.reader import Chooses, RecordingError, Summary, mapped, read
from pebble.recordings.files.scan import Damage

ACTIVE: Final = ".mcap.active"  # is being written, or was left by a recorder that was killed
FOREVER_NS: Final = (1 << 63) - 1


@dataclass(frozen=True, slots=True)
class Span:
    """From the first message to the last, in nanoseconds since 1970."""

    first_ns: int
    last_ns: int


def files(places: Iterable[Path]) -> list[Path]:
    """The recordings among ``places`` and in folders there, finished or not. Raises RecordingError if there is none."""
    found: list[Path] = []
    for place in places:
        if place.is_dir():
            found += sorted(path for path in place.rglob(f"*{SUFFIX}*") if path.name.endswith((SUFFIX, ACTIVE)))
        elif _begins_as_mcap(place):
            found.append(place)
        else:
            raise RecordingError(f"{place}: is not a recording (MCAP)")
    if not found:
        raise RecordingError(f"{', '.join(map(str, places))}: there is no recording")
    return found


def span(path: Path) -> Span | None:
    """The time that a file covers; None if it holds no message. One that is not finished is read as far as needed."""
    with mapped(path) as data:
        summary = Summary.of(data)
        if summary is None:
            first = next(read(data), None)
            return None if first is None else Span(first.log_ns, FOREVER_NS)
        counted = summary.statistics
        return Span(counted.first_ns, counted.last_ns) if counted.messages else None


def merged(
    paths: Iterable[Path],
    *,
    since_ns: int = 0,
    until_ns: int = FOREVER_NS,
    chooses: Chooses = lambda _channel: True,
    damage: Damage | None = None,
) -> Iterator[Recorded]:
    """The messages of all files from ``since_ns`` to before ``until_ns``, by the time at which they were received.

    A file is open only while its time has come: its chunks outside the period are not unpacked.
    """
    damage = Damage() if damage is None else damage
    spans = ((span(path), path) for path in paths)
    due = [(one.first_ns, path) for one, path in spans if one and one.last_ns >= since_ns and one.first_ns < until_ns]
    due.sort(reverse=True)
    heap: list[tuple[int, int, Recorded, Iterator[Recorded]]] = []
    number = 0
    while due or heap:
        while due and (not heap or max(due[-1][0], since_ns) <= heap[0][0]):
            reading = _messages(due.pop()[1], since_ns, until_ns, chooses, damage)
            number += 1
            _push(heap, number, reading)
        if not heap:
            continue
        _, turn, message, reading = heap[0]
        yield message
        following = next(reading, None)
        if following is None:
            heapq.heappop(heap)
        else:
            heapq.heapreplace(heap, (following.log_ns, turn, following, reading))


def _push(heap: list[Any], number: int, reading: Iterator[Recorded]) -> None:
    first = next(reading, None)
    if first is not None:
        heapq.heappush(heap, (first.log_ns, number, first, reading))


def _messages(path: Path, since_ns: int, until_ns: int, chooses: Chooses, damage: Damage) -> Iterator[Recorded]:
    if not path.exists() and path.name.endswith(ACTIVE):  # finished meanwhile
        path = path.with_name(path.name.removesuffix(ACTIVE) + SUFFIX)
    if not path.exists():  # deleted meanwhile, to make room
        return
    with mapped(path) as data:
        for message in read(data, damage, chooses=chooses, since_ns=since_ns, until_ns=until_ns):
            if since_ns <= message.log_ns < until_ns:
                yield message


def _begins_as_mcap(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return file.read(len(MAGIC)) == MAGIC
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror or error}") from None


def robot_of(channel: Channel) -> str | None:
    """``system/type/id`` of a channel's topic; None if it has none."""
    levels = channel.topic.split("/", 4)
    return "/".join(levels[:3]) if len(levels) == 5 and levels[3] in ("incoming", "outgoing") else None
