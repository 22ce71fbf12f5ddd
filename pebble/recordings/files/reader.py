"""Reads MCAP files in any state: all that can be read, and what is missing."""

from __future__ import annotations

import mmap
import os
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from pebble.errors import PebbleError
from pebble.recordings.files import mcap
from pebble.recordings.files.mcap import MESSAGE, Channel, ChunkIndex, DamageError, Metadata, Op, Recorded, Statistics
from pebble.recordings.files.reading_lock import share
from pebble.recordings.files.scan import Block, Damage, blocks

SUFFIX: Final = ".mcap"  # of a file that is finished
#: The topic of messages whose channel is not named anywhere in a damaged file, before its number.
UNNAMED: Final = "$recorder/unnamed/"

DAMAGE: Final = "pebble.damage"  # the metadata of a file that was finished with a part of it missing
MISSING: Final = "missing_messages"

Chooses = Callable[[Channel], bool]


class RecordingError(PebbleError):
    """A file that cannot be read as a recording. Example: ``walk.mcap: No such file or directory``."""


def unnamed(number: int) -> Channel:
    """A name for a channel that has lost its own."""
    return Channel(number, f"{UNNAMED}{number}", "application/octet-stream")


@contextmanager
def mapped(path: Path) -> Iterator[Any]:
    """The bytes of a file. Raises RecordingError."""
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
        raise RecordingError(f"{path}: {error.strerror or error}") from None


def read(
    data: Any,
    damage: Damage | None = None,
    *,
    chooses: Chooses = lambda _channel: True,
    since_ns: int = 0,
    until_ns: int = 1 << 63,
) -> Iterator[Recorded]:
    """The messages of the channels that ``chooses`` accepts, in the order of the file.

    What is wrong with the file is noted in ``damage``. Chunks of a finished file that lie outside the period are left
    out; messages outside it may come all the same.
    """
    damage = Damage() if damage is None else damage
    reading = _Reading(data, damage, chooses)
    begin, end = reading.part(since_ns, until_ns)
    for block in blocks(data, damage, begin):
        if end is not None and block.at >= end:
            return
        yield from reading.messages(block)
    if not begin:
        reading.end()


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
        self._channels: dict[int, Channel | None] = {}  # None: not chosen
        self._summary = Summary.of(data)
        self._unnamed: set[int] = set()
        self._looked_ahead = False
        self._due = self._read = 0
        for channel in () if self._summary is None else self._summary.channels.values():
            self._add(channel)

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

    def messages(self, block: Block) -> Iterator[Recorded]:
        if block.op is not Op.CHUNK:
            return
        for op, begin, end in mcap.records(block.body):
            if op == Op.MESSAGE:
                message = self._message(block, begin, end)
                if message is not None:
                    yield message
            elif op == Op.CHANNEL:
                self._add(Channel.unpack(block.body[begin:end]))

    def end(self) -> None:
        if self._summary is not None:  # messages at the end may be missing, too
            missed_before = mcap.number_in(metadata_of(self._data).get(DAMAGE, {}), MISSING)
            before = self._summary.statistics.messages + missed_before
            self._damage.missing = max(self._damage.missing, before - self._read)

    def _message(self, block: Block, begin: int, end: int) -> Recorded | None:
        number, sequence, log_ns, publish_ns = MESSAGE.unpack_from(block.body, begin)
        if sequence > self._due >= 0:
            self._damage.missing += sequence - self._due
        self._due = sequence + 1
        self._read += 1
        if number not in self._channels and not self._find(number, block):
            self._add(unnamed(number))
        if number in self._unnamed:
            self._damage.orphans += 1
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
                        if op == Op.CHANNEL:
                            self._add(Channel.unpack(later.body[begin:end]))
        return number in self._channels

    def _add(self, channel: Channel) -> None:
        if channel.topic.startswith(UNNAMED):
            self._unnamed.add(channel.id)
        if channel.id not in self._channels:
            chosen = channel.topic == mcap.OTHER or self._chooses(channel)
            self._channels[channel.id] = channel if chosen else None


@dataclass(frozen=True, slots=True)
class Summary:
    """What a finished file says about itself."""

    channels: dict[int, Channel]
    chunks: list[ChunkIndex]
    statistics: Statistics
    metadata: list[int]  # where they are

    @classmethod
    def of(cls, data: Any) -> Summary | None:
        """None for a file that is not finished, or whose summary is damaged."""
        found = mcap.summary_of(data)
        if found is None:
            return None
        channels: dict[int, Channel] = {}
        chunks, statistics, metadata = [], None, []
        try:
            for op, begin, end in mcap.records(found[1]):
                body = found[1][begin:end]
                if op == Op.CHANNEL:
                    channel = Channel.unpack(body)
                    channels[channel.id] = channel
                elif op == Op.CHUNK_INDEX:
                    chunks.append(ChunkIndex.unpack(body))
                elif op == Op.STATISTICS:
                    statistics = Statistics.unpack(body)
                elif op == Op.METADATA_INDEX:
                    metadata.append(int.from_bytes(body[:8], "little"))
        except DamageError:
            return None
        return None if statistics is None else cls(channels, chunks, statistics, metadata)
