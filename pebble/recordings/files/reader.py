"""Reads MCAP files in any state: all that can be read, and what is missing."""

from __future__ import annotations

import heapq
import mmap
import os
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import Any, Final

from pebble.recordings.files import mcap
from pebble.recordings.files.mcap import MESSAGE, Channel, ChunkIndex, DamageError, Metadata, Op, Recorded, Statistics
from pebble.recordings.files.reading_lock import share
from pebble.recordings.files.scan import Block, Damage, block_at, blocks, is_of_others

SUFFIX: Final = ".mcap"  # of a file that is finished
#: The topic of messages whose channel is not named anywhere in a damaged file, before its number.
UNNAMED: Final = "$recorder/unnamed/"

DAMAGE: Final = "pebble.damage"  # the metadata of a file that was finished with a part of it missing
MISSING: Final = "missing_messages"

FOREVER_NS: Final = 1 << 64  # after all times that a file can hold

_MOST_OPEN: Final = 512 << 20  # bytes of chunks that are sorted at the same time
_time = attrgetter("log_ns")

Chooses = Callable[[Channel], bool]


def unnamed(number: int) -> Channel:
    """A name for a channel that has lost its own."""
    return Channel(number, f"{UNNAMED}{number}", "application/octet-stream")


@contextmanager
def mapped(path: Path) -> Iterator[Any]:
    """The bytes of a file. Raises RecordingError, also for what is found in them meanwhile."""
    try:
        with path.open("rb") as file:
            if not path.name.endswith(SUFFIX):
                share(file)
            if not os.fstat(file.fileno()).st_size:
                yield b""
                return
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                yield data
    except OSError as error:
        raise mcap.RecordingError(f"{path}: {error.strerror or error}") from None
    except mcap.UnreadableError as error:
        raise mcap.UnreadableError(f"{path}: {error}") from None
    except DamageError as error:
        raise mcap.RecordingError(f"{path}: {error}") from None


def read(
    data: Any,
    damage: Damage | None = None,
    *,
    chooses: Chooses = lambda _channel: True,
    since_ns: int = 0,
    until_ns: int = FOREVER_NS,
) -> Iterator[Recorded]:
    """The messages of the channels that ``chooses`` accepts, in the order of time.

    What is wrong with the file is noted in ``damage``. Chunks of a finished file that lie outside the period are left
    out; messages outside it may come all the same. Raises UnreadableError.
    """
    damage = Damage() if damage is None else damage
    reading = _Reading(data, damage, chooses)
    if not reading.is_in_order:
        yield from reading.sorted(since_ns, until_ns)
        return
    begin, end = reading.part(since_ns, until_ns)
    for block in blocks(data, damage, begin):
        if end is not None and block.at >= end:
            break
        if block.op is Op.CHUNK:
            yield from reading.messages(block)
    reading.end(whole=not begin and end is None)


def in_time_order(streams: Iterable[tuple[int, Callable[[], Iterator[Recorded]]]]) -> Iterator[Recorded]:
    """The messages of several streams by their times; of each: its first time, and what opens it when that has come."""
    due = sorted(streams, key=lambda one: one[0])
    due.reverse()
    heap: list[tuple[int, int, Recorded, Iterator[Recorded]]] = []
    turn = 0
    while due or heap:
        while due and (not heap or due[-1][0] <= heap[0][0]):
            stream = due.pop()[1]()
            turn += 1
            if (first := next(stream, None)) is not None:
                heapq.heappush(heap, (first.log_ns, turn, first, stream))
        if not heap:
            continue
        _, number, message, stream = heap[0]
        yield message
        if (following := next(stream, None)) is None:
            heapq.heappop(heap)
        else:
            heapq.heapreplace(heap, (following.log_ns, number, following, stream))


def metadata_of(data: Any) -> dict[str, dict[str, str]]:
    """The named texts of a file, which stand before its messages or at its end; of two with one name the last."""
    found: dict[str, dict[str, str]] = {}
    summary = Summary.of(data)
    if summary is not None:
        for at in summary.metadata:
            with suppress(DamageError, struct.error):  # what the summary of another program's file says may be wrong
                _, length = mcap.HEAD.unpack_from(data, at)
                one = Metadata.unpack(data[at + mcap.HEAD.size : at + mcap.HEAD.size + length])
                found[one.name] = dict(one.items)
        return found
    for block in blocks(data, Damage()):
        if block.op is not Op.METADATA:
            break
        one = Metadata.unpack(block.body)
        found[one.name] = dict(one.items)
    return found


class _Reading:
    """The channels and numbers of a file while it is read."""

    def __init__(self, data: Any, damage: Damage, chooses: Chooses) -> None:
        self._data, self._damage, self._chooses = data, damage, chooses
        self._is_of_others = is_of_others(data)
        self._summary = Summary.of(data)
        self._schemas: dict[int, mcap.Schema] = {}
        self._declared: dict[int, Channel] = {}
        self._channels: dict[int, Channel | None] = {}  # None: not chosen
        self._counts = Counter[int]()  # messages by channel, of a first reading
        self._unnamed: set[int] = set()
        self._looked_ahead = False
        self._due = self._read = 0
        self._open = 0  # bytes of chunks that are read at the same time
        if self._summary is not None and not self._is_of_others:
            self._schemas.update(self._summary.schemas)
            for channel in self._summary.channels.values():
                self._add(channel)

    @property
    def is_in_order(self) -> bool:
        """Whether the chunks follow each other in time: not those of other programs, nor of what was imported."""
        chunks = [] if self._summary is None else [one for one in self._summary.chunks if one.start_ns]
        return not self._is_of_others and all(one.end_ns <= two.start_ns for one, two in pairwise(chunks))

    def part(self, since_ns: int, until_ns: int) -> tuple[int, int | None]:
        """Where the chunks begin and end that may hold messages of the period; 0 and None: the whole file."""
        chunks = [] if self._summary is None else self._summary.chunks
        if not chunks or (chunks[0].start_ns >= since_ns and chunks[-1].end_ns < until_ns):
            return 0, None
        wanted = [one for one in chunks if (one.end_ns >= since_ns and one.start_ns < until_ns) or not one.start_ns]
        if not wanted:
            return len(self._data), None
        first, last = wanted[0], wanted[-1]
        self._due = -1  # its numbers begin anywhere
        return (0 if first is chunks[0] else first.at), last.at + 1

    def messages(self, block: Block) -> list[Recorded]:
        """Those of a chunk in the order of time."""
        found: list[Recorded] = []
        for op, begin, end in mcap.records(block.body):
            if op == Op.MESSAGE:
                number, sequence, _, _ = MESSAGE.unpack_from(block.body, begin)
                self._count(sequence)
                if number not in self._channels and not self._find(number, block):
                    self._add(unnamed(number))
                if number in self._unnamed:
                    self._damage.orphans += 1
                message = self._message(block, begin, end)
                if message is not None:
                    found.append(message)
            else:
                self._declare(op, block.body[begin:end])
        found.sort(key=_time)
        return found

    def sorted(self, since_ns: int, until_ns: int) -> Iterator[Recorded]:
        """All in the order of time, after a first reading that finds the channels, and the times of each chunk."""
        places = []
        for block in blocks(self._data, self._damage):
            times = self._look_at(block) if block.op is Op.CHUNK else None
            if times is not None and times[1] >= since_ns and times[0] < until_ns:
                places.append((times[0], partial(self._opened, block.at, block.record_end)))
        summary = self._summary
        self._schemas = {**({} if summary is None else summary.schemas), **self._schemas}
        for channel in (*self._declared.values(), *(() if summary is None else summary.channels.values())):
            self._add(channel)
        for number in self._counts.keys() - self._channels.keys():
            self._add(unnamed(number))
        self._damage.orphans += sum(self._counts[number] for number in self._unnamed)
        self.end(whole=True)
        yield from in_time_order(places)

    def end(self, *, whole: bool) -> None:
        if self._summary is None:
            return
        self._damage.known = mcap.number_in(metadata_of(self._data).get(DAMAGE, {}), MISSING)
        if whole:  # messages at the end may be missing, too
            before = self._summary.statistics.messages + self._damage.known
            self._damage.missing = max(self._damage.missing, before - self._read)

    def _look_at(self, block: Block) -> tuple[int, int] | None:
        """The first and the last time of a chunk; None for one without messages."""
        times = []
        try:
            for op, begin, end in mcap.records(block.body):
                if op == Op.MESSAGE:
                    number, sequence, log_ns, _ = MESSAGE.unpack_from(block.body, begin)
                    self._count(-1 if self._is_of_others else sequence)
                    self._counts[number] += 1
                    times.append(log_ns)
                else:
                    self._declare(op, block.body[begin:end])
        except DamageError as error:
            self._damage.spans.append((block.at, block.record_end))
            self._damage.note(error)
        return (min(times), max(times)) if times else None

    def _opened(self, at: int, end: int) -> Iterator[Recorded]:
        block = block_at(self._data, at, end)
        self._open += len(block.body)
        if self._open > _MOST_OPEN:
            raise mcap.UnreadableError(
                f"over {_MOST_OPEN >> 20} MB of it are not in the order of time: `mcap sort` puts them so"
            )
        found = []
        for op, begin, stop in mcap.records(block.body):
            message = self._message(block, begin, stop) if op == Op.MESSAGE else None
            if message is not None:
                found.append(message)
        found.sort(key=_time)
        yield from found
        self._open -= len(block.body)

    def _count(self, sequence: int) -> None:
        if sequence > self._due >= 0:
            self._damage.missing += sequence - self._due
        self._due = sequence + 1
        self._read += 1

    def _message(self, block: Block, begin: int, end: int) -> Recorded | None:
        number, sequence, log_ns, publish_ns = MESSAGE.unpack_from(block.body, begin)
        channel = self._channels[number]
        if channel is None:
            return None
        payload = block.body[begin + MESSAGE.size : end]
        if channel.topic == mcap.OTHER:
            with suppress(DamageError):  # another program may use that topic
                channel, payload = mcap.unpack_other(channel, payload)
            if not self._chooses(channel):
                return None
        return Recorded(channel, sequence, log_ns, publish_ns, payload)

    def _find(self, number: int, block: Block) -> bool:
        """Look for a channel further on: the chunk that named it first may be lost."""
        if not self._looked_ahead:
            self._looked_ahead = True
            for later in blocks(self._data, Damage(), block.at):
                if later.op is Op.CHUNK:
                    for op, begin, end in mcap.records(later.body):
                        self._declare(op, later.body[begin:end])
        return number in self._channels

    def _declare(self, op: int, body: bytes) -> None:
        """Take over a record of a chunk that is no message."""
        if op == Op.SCHEMA:
            schema = mcap.Schema.unpack(body)
            self._refuse_another(self._schemas.setdefault(schema.id, schema), schema)
        elif op == Op.CHANNEL:
            channel = Channel.unpack(body)
            self._refuse_another(self._declared.setdefault(channel.id, channel), channel)
            if not self._is_of_others:
                self._add(channel)
        elif op != Op.MESSAGE_INDEX:
            self._damage.private += 1

    def _refuse_another(self, known: Channel | mcap.Schema, one: Channel | mcap.Schema) -> None:
        if self._is_of_others and known != one:
            raise mcap.UnreadableError(f"{type(one).__name__.lower()} {one.id} is declared as two different ones")

    def _add(self, channel: Channel) -> None:
        if channel.topic.startswith(UNNAMED):
            self._unnamed.add(channel.id)
        if channel.id not in self._channels:
            if channel.schema:
                channel = replace(channel, described=self._schemas.get(channel.schema))
            chosen = channel.topic == mcap.OTHER or self._chooses(channel)
            self._channels[channel.id] = channel if chosen else None


@dataclass(frozen=True, slots=True)
class Summary:
    """What a finished file says about itself."""

    channels: dict[int, Channel]
    chunks: list[ChunkIndex]
    statistics: Statistics
    metadata: list[int]  # where they are
    schemas: dict[int, mcap.Schema]

    @classmethod
    def of(cls, data: Any) -> Summary | None:
        """None for a file that is not finished, or whose summary is damaged, or does not say all.

        What another program writes into its summary counts if two of its records agree.
        """
        found = mcap.summary_of(data)
        if found is None:
            return None
        channels: dict[int, Channel] = {}
        schemas: dict[int, mcap.Schema] = {}
        chunks, statistics, metadata = [], None, []
        try:
            for op, begin, end in mcap.records(found[1]):
                body = found[1][begin:end]
                if op == Op.CHANNEL:
                    channel = Channel.unpack(body)
                    channels[channel.id] = channel
                elif op == Op.SCHEMA:
                    schema = mcap.Schema.unpack(body)
                    schemas[schema.id] = schema
                elif op == Op.CHUNK_INDEX:
                    chunks.append(ChunkIndex.unpack(body))
                elif op == Op.STATISTICS:
                    statistics = Statistics.unpack(body)
                elif op == Op.METADATA_INDEX:
                    metadata.append(int.from_bytes(body[:8], "little"))
        except DamageError:
            return None
        if statistics is None or statistics.messages != sum(statistics.counts.values()):
            return None
        made = cls(channels, chunks, statistics, metadata, schemas)
        return None if is_of_others(data) and not made._agrees() else made

    def _agrees(self) -> bool:
        about = self.statistics
        times = [(one.start_ns, one.end_ns) for one in self.chunks if one.indexes]
        if not times or not about.counts.keys() <= self.channels.keys():
            return False
        return (min(one for one, _ in times), max(one for _, one in times)) == (about.first_ns, about.last_ns)
