"""Reads MCAP files in any state: all that can be read, and how much is missing.

A finished file is read by its summary. Where there is none, because the file is being written, or its recorder was
killed, or its end is damaged, its records are looked through once. Behind damage reading goes on at the next chunk
whose checksum is right.
"""

from __future__ import annotations

import heapq
import os
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from pebble.recordings.files.recorded import (
    FOREVER_NS,
    Channel,
    Damage,
    DamageError,
    Recorded,
    RecordingError,
    Schema,
    number_in,
    require_package,
    unnamed,
)
from pebble.recordings.files.records import (
    CHUNK,
    FOOTER,
    HEAD,
    INDEX,
    LARGEST_CHUNK,
    LOOKS_LIKE_CHUNK,
    MAGIC,
    MESSAGE,
    Op,
    channel_of,
    record_of,
    records,
    schema_of,
    summary_of,
    unpack_chunk,
    with_own_topic,
)

if TYPE_CHECKING:
    from mcap.records import Attachment, ChunkIndex, McapRecord, Metadata, Statistics
    from mcap.summary import Summary

DAMAGE, MISSING = "pebble.damage", "missing_messages"  # metadata of a copy of a file of which a part was missing
#: Names of the last version: of that metadata, and of the channel of topics for which a file had no room.
OLD_COPY, OLD_OTHER = "pebble.rewritten", "$recorder/other"

_INDEX_ENTRY, _INDEXES = 16, 8192  # bytes: of one entry; that are read at once behind a chunk
_CHECKSUM: Final = 4  # bytes
_LONGEST_NAME: Final = 16  # of a compression
_LARGEST_HEADER: Final = 1 << 16
_LARGEST_SUMMARY: Final = 256 << 20
_LARGEST_RECORD: Final = LARGEST_CHUNK + (1 << 16)
_SEARCHED, _OVERLAP = 1 << 20, 64  # bytes behind damage that are read at once
_MOST_OPEN: Final = 512 << 20  # bytes of chunks that are sorted at the same time
_time = attrgetter("log_ns")

Chooses = Callable[[Channel], bool]


class Chunk(NamedTuple):
    """Where a chunk is, and what it holds; ``channels`` empty: not known, so it may hold any."""

    start_ns: int
    end_ns: int
    at: int
    length: int  # with its head
    channels: frozenset[int] = frozenset()
    messages: int = 0  # 0: not known


class RecordingFile:
    """One file, finished or not. Not thread-safe. Each method raises RecordingError."""

    def __init__(self, path: Path) -> None:
        require_package()
        self.path, self.damage = path, Damage()
        self.channels: dict[int, Channel] = {}
        self.chunks: list[Chunk] = []
        self.is_ours = True  # and its messages are numbered
        self.statistics: Statistics | None = None  # None: it is not finished, or does not say all
        self._schemas: dict[int, Schema] = {}
        self._names: dict[int, Channel] = {}  # channels that are named beside chunks, where no checksum protects them
        self._beside: list[int] = []  # where metadata and attachments are
        self._at = self._searched = len(MAGIC)  # how far it was looked through, and how far for a chunk
        self._again_at = 0  # the last chunk, behind which more indexes may be written yet
        self._size, self._ended, self._looked_everywhere = 0, False, False
        try:
            self._file = path.open("rb")
        except OSError as error:
            raise RecordingError(f"{path}: {error.strerror or error}") from None
        try:
            self._open()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> RecordingFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._file.close()

    @property
    def first_ns(self) -> int:
        """When the first message was received; 0: there is none."""
        return min((chunk.start_ns for chunk in self.chunks if chunk.start_ns), default=0)

    @property
    def last_ns(self) -> int:
        return max((chunk.end_ns for chunk in self.chunks), default=0)

    @property
    def is_cut_off(self) -> bool:
        """Whether nothing is at its end but zeros, or the begin of one record: so a kill leaves it."""
        rest = self._read(self._at, min(self.damage.torn, _LARGEST_RECORD))
        if len(rest) < HEAD.size or not any(rest):
            return len(rest) >= self.damage.torn
        op, length = HEAD.unpack_from(rest)
        return self._may_begin(op, length) and self._at + HEAD.size + length > self._size

    def refresh(self) -> None:
        """Find what was written since; a file that is finished does not change."""
        if self.statistics is None:
            self._size = os.fstat(self._file.fileno()).st_size
            self._look_through()

    def read(
        self, *, chooses: Chooses = lambda _channel: True, since_ns: int = 0, until_ns: int = FOREVER_NS
    ) -> Iterator[Recorded]:
        """Yield the messages of the channels that ``chooses`` accepts, in the order of time.

        What is wrong is noted in :attr:`damage`. Chunks outside the period are left out; messages outside it may come.
        """
        chunks = [chunk for chunk in self.chunks if chunk.end_ns >= since_ns and chunk.start_ns < until_ns]
        if any(one.end_ns > two.start_ns for one, two in pairwise(chunks)):  # other programs write in any order
            opened = [0]
            yield from in_time_order(
                (chunk.start_ns, partial(self._opened, chunk, chooses, opened)) for chunk in chunks
            )
            return
        due = 0 if len(chunks) == len(self.chunks) else None
        for chunk in chunks:
            messages, numbers = self._unpacked(chunk, chooses)
            if numbers is not None and self.is_ours and self.statistics is None:
                self.damage.missing += 0 if due is None else max(0, numbers[0] - due)
                due = numbers[1] + 1
            elif due is not None:
                due += chunk.messages  # they are counted as damaged
            yield from messages

    def messages(self, chunk: Chunk, chooses: Chooses = lambda _channel: True) -> list[Recorded]:
        """Return those of one chunk in the order of time; none if it is damaged."""
        return self._unpacked(chunk, chooses)[0]

    def metadata(self) -> dict[str, dict[str, str]]:
        """Return the named texts of the file; of two with one name the last."""
        from mcap.records import Metadata

        found = (record for record in self._records_beside() if isinstance(record, Metadata))
        return {record.name: record.metadata for record in found}

    def beside(self) -> Iterator[Metadata | Attachment]:
        """Yield what the file holds beside messages."""
        from mcap.records import Attachment, Metadata

        for record in self._records_beside():
            if isinstance(record, Metadata | Attachment):
                yield record

    # -- a finished file

    def _open(self) -> None:
        self._size = os.fstat(self._file.fileno()).st_size
        if not self._size:
            self.damage.why = "it is empty"
        elif self._read(0, len(MAGIC)) != MAGIC:
            self.damage.add(0, "it does not begin as MCAP does")
        self._read_header()
        summary = self._summary()
        if summary is None or not self._take_over(summary):
            self._look_through()

    def _read_header(self) -> None:
        from mcap.records import Header

        try:
            header = record_of(self._read(self._at, _LARGEST_HEADER))
        except DamageError:
            return
        if isinstance(header, Header):
            self.is_ours = header.library.startswith("pebble")

    def _summary(self) -> Summary | None:
        """None: it is not finished, its end is damaged, or it has none."""
        tail = FOOTER.size + len(MAGIC)
        footer = self._read(max(0, self._size - tail), tail)
        if len(footer) < tail or footer[FOOTER.size :] != MAGIC:
            return None
        op, length, start, _, checksum = FOOTER.unpack_from(footer)
        size = self._size - start if start else tail
        if op != Op.FOOTER or length != FOOTER.size - HEAD.size or not tail <= size <= _LARGEST_SUMMARY:
            return None
        end = self._read(self._size - size, size)
        if checksum and zlib.crc32(end[: -len(MAGIC) - _CHECKSUM]) != checksum:
            return None
        self.damage.finished = True
        try:
            return summary_of(end)
        except DamageError:
            return None

    def _take_over(self, summary: Summary) -> bool:
        """Whether the summary names all messages: those of other programs need not."""
        chunks = [_indexed(index) for index in summary.chunk_indexes if index.message_index_offsets]
        counted = summary.statistics
        if counted is None or counted.message_count != sum(chunk.messages for chunk in chunks):
            return False
        if not counted.channel_message_counts.keys() <= summary.channels.keys():
            return False
        self._schemas = {number: Schema(one.name, one.encoding, one.data) for number, one in summary.schemas.items()}
        for number, one in summary.channels.items():
            schema = self._schemas.get(one.schema_id)
            self.channels[number] = Channel(number, one.topic, one.message_encoding, one.metadata, schema)
        self._beside = [index.offset for index in summary.metadata_indexes]
        self._beside += [index.offset for index in summary.attachment_indexes]
        self.chunks, self.statistics = chunks, counted
        return True

    # -- one that is not

    def _look_through(self) -> None:
        """Find the chunks, and the names of channels, from where the last look has ended."""
        if self._again_at and not self._ended:
            self.chunks.pop()
            self._at, self._again_at = self._again_at, 0
        while self._at < self._size and not self._ended:
            record = self._record_at(self._at)
            if record is not None:
                self._at = self._take(*record)
                continue
            again = self._next_chunk(max(self._at + 1, self._searched))
            if again is None:
                self._searched = max(self._searched, self._size - _OVERLAP)
                break
            self.damage.add(self._at, f"{again - self._at:,} bytes are no record")
            self._at = again
        self.damage.torn = 0 if self._ended else max(0, self._size - self._at)

    def _record_at(self, at: int) -> tuple[int, int] | None:
        """The opcode of the record at ``at``, and its end; None if it is none, or not all of it is there."""
        head = self._read(at, HEAD.size)
        if len(head) < HEAD.size:
            return None
        op, length = HEAD.unpack_from(head)
        end = at + HEAD.size + length
        if end > self._size:
            return None
        if op == Op.CHUNK:
            is_one = self._is_chunk(at, length)
        elif op == Op.CHANNEL:
            is_one = self._is_channel(at, length)
        elif op == Op.DATA_END:
            is_one = length == _CHECKSUM
        elif op == Op.MESSAGE and not self.is_ours:
            raise RecordingError(f"{self.path}: its messages are not in chunks: mcap compress {self.path.name} -o OUT")
        else:
            is_one = self._may_begin(op, length) and self._begins_record(end)
        return (op, end) if is_one else None

    def _begins_record(self, at: int) -> bool:
        """Whether a record may begin at ``at``, or the file ends there."""
        head = self._read(at, HEAD.size)
        return len(head) < HEAD.size or self._may_begin(*HEAD.unpack(head))

    def _may_begin(self, op: int, length: int) -> bool:
        is_known = Op.HEADER <= op <= Op.DATA_END or op == Op.PADDING or (op > 0 and not self.is_ours)
        return is_known and length <= _LARGEST_SUMMARY

    def _is_chunk(self, at: int, length: int) -> bool:
        """Whether the lengths in its head agree."""
        head = self._read(at + HEAD.size, CHUNK.size + _LONGEST_NAME + 8)
        if len(head) < CHUNK.size + 8:
            return False
        data_at = CHUNK.size + min(CHUNK.unpack_from(head)[4], _LONGEST_NAME)
        packed = int.from_bytes(head[data_at : data_at + 8], "little")
        return length == data_at + 8 + packed and length < _LARGEST_RECORD

    def _is_channel(self, at: int, length: int) -> bool:
        """Whether it is exactly what it says."""
        try:
            channel_of(self._read(at + HEAD.size, min(length, _LARGEST_RECORD)))
        except DamageError:
            return False
        return True

    def _take(self, op: int, end: int) -> int:
        """Take over the record at hand; returns where the next one begins."""
        at = self._at
        if op == Op.CHUNK:
            return self._take_chunk(at, end)
        if op in (Op.METADATA, Op.ATTACHMENT):
            self._beside.append(at)
        elif op in (Op.SCHEMA, Op.CHANNEL):
            try:
                self._declare(op, self._read(at + HEAD.size, end - at - HEAD.size), self._names)
            except DamageError as error:
                self.damage.add(at, error)
        self._ended = op == Op.DATA_END
        return end

    def _take_chunk(self, at: int, end: int) -> int:
        start_ns, end_ns = CHUNK.unpack(self._read(at + HEAD.size, CHUNK.size))[:2]
        entries, after, are_all = self._indexes(end)
        self._again_at = 0 if are_all else at
        channels = frozenset(entries if are_all else ())
        chunk = Chunk(start_ns, end_ns, at, end - at, channels, sum(entries.values()))
        self.chunks.append(chunk)
        if not entries or not entries.keys() <= self.channels.keys():
            self._learn(chunk)
        return after

    def _indexes(self, at: int) -> tuple[dict[int, int], int, bool]:
        """The messages by channel that are indexed behind a chunk, where that ends, and whether these are all."""
        entries, data, place = dict[int, int](), b"", 0
        while True:
            if place + INDEX.size > len(data):
                at, place = at + place, 0
                data = self._read(at, _INDEXES)
                if len(data) < INDEX.size:
                    return entries, at, False
            op, length, channel, size = INDEX.unpack_from(data, place)
            after = place + HEAD.size + length
            if op != Op.MESSAGE_INDEX or length != INDEX.size - HEAD.size + size or at + after > self._size:
                return entries, at + place, op != Op.MESSAGE_INDEX
            entries[channel] = size // _INDEX_ENTRY
            place = after

    def _learn(self, chunk: Chunk) -> None:
        """Take over the names of channels in a chunk, which uses them first."""
        try:
            data = self._records(chunk)
            for op, begin, end in records(data):
                self._declare(op, data[begin:end], self.channels)
        except DamageError as error:
            self.damage.add(chunk.at, error, chunk.messages)
            return
        for number in self._names.keys() - self.channels.keys():
            if not chunk.channels or number in chunk.channels:
                self.channels[number] = self._names[number]

    def _next_chunk(self, at: int) -> int | None:
        """Where behind damage the next chunk begins."""
        while at < self._size:
            part, found = self._read(at, _SEARCHED + _OVERLAP), -1
            while (match := LOOKS_LIKE_CHUNK.search(part, found + 1)) is not None and match.start() < _SEARCHED:
                found = match.start()
                record = self._record_at(at + found)
                if record is not None and self._is_whole(at + found, record[1]):
                    return at + found
            at += _SEARCHED
        return None

    def _is_whole(self, at: int, end: int) -> bool:
        try:
            for _ in records(self._records(Chunk(0, 0, at, end - at))):
                pass
        except DamageError:
            return False
        return True

    # -- both

    def _unpacked(self, chunk: Chunk, chooses: Chooses) -> tuple[list[Recorded], tuple[int, int] | None]:
        """The chosen messages of a chunk, and the numbers of its first and last one."""
        found: list[Recorded] = []
        first, last = -1, -1
        chosen: dict[int, Channel | None] = {}
        lost: set[int] = set()
        try:
            data = self._records(chunk)
            for op, begin, end in records(data):
                if op != Op.MESSAGE:
                    self._declare(op, data[begin:end], self.channels)
                    continue
                number, sequence, log_ns, publish_ns = MESSAGE.unpack_from(data, begin)
                first, last = sequence if first < 0 else first, sequence
                if number not in chosen:
                    channel = self._channel(number)
                    lost |= {number} - self.channels.keys()
                    chosen[number] = channel if channel.topic == OLD_OTHER or chooses(channel) else None
                if lost and number in lost:
                    self.damage.unnamed += 1
                taken = chosen[number]
                if taken is not None:
                    found.append(Recorded(taken, sequence, log_ns, publish_ns, data[begin + MESSAGE.size : end]))
            if any(channel is not None and channel.topic == OLD_OTHER for channel in chosen.values()):
                found = [message for message in map(_with_own_topic, found) if chooses(message.channel)]
        except DamageError as error:
            self.damage.add(chunk.at, error, chunk.messages)
            return [], None
        found.sort(key=_time)
        return found, (first, last) if first >= 0 else None

    def _opened(self, chunk: Chunk, chooses: Chooses, opened: list[int]) -> Iterator[Recorded]:
        opened[0] += chunk.length
        if opened[0] > _MOST_OPEN:
            raise RecordingError(
                f"{self.path}: over {_MOST_OPEN >> 20} MB of it are not in the order of time: `mcap sort` puts them so"
            )
        yield from self.messages(chunk, chooses)
        opened[0] -= chunk.length

    def _declare(self, op: int, body: bytes, channels: dict[int, Channel]) -> None:
        """Take over a record that is no message. Raises DamageError."""
        if op == Op.SCHEMA:
            number, schema = schema_of(body)
            self._schemas.setdefault(number, schema)
        elif op == Op.CHANNEL:
            channel, number = channel_of(body)
            channels.setdefault(channel.id, replace(channel, schema=self._schemas.get(number)))

    def _channel(self, number: int) -> Channel:
        """The channel of this number, wherever it is named: the chunk that named it first may be lost."""
        if number not in self.channels and number in self._names:
            self.channels[number] = self._names[number]
        if number not in self.channels and not self._looked_everywhere:
            self._looked_everywhere = True
            for chunk in self.chunks:
                self._learn(chunk)
        return self.channels.get(number) or unnamed(number)

    def _records(self, chunk: Chunk) -> bytes:
        """The records of a chunk. Raises DamageError."""
        head = self._read(chunk.at, HEAD.size if chunk.length < _LARGEST_RECORD else 0)
        if len(head) < HEAD.size or HEAD.unpack(head) != (Op.CHUNK, chunk.length - HEAD.size):
            raise DamageError("a chunk is damaged")
        return unpack_chunk(self._read(chunk.at + HEAD.size, chunk.length - HEAD.size))

    def _records_beside(self) -> Iterator[McapRecord]:
        for at in self._beside:
            head = self._read(at, HEAD.size)
            length = HEAD.unpack(head)[1] if len(head) == HEAD.size else _LARGEST_RECORD
            try:
                if length >= _LARGEST_RECORD:
                    raise DamageError("metadata, or an attachment, of a size that cannot be")
                yield record_of(self._read(at, HEAD.size + length))
            except DamageError as error:
                self.damage.add(at, error)

    def _read(self, at: int, length: int) -> bytes:
        try:
            self._file.seek(at)
            return self._file.read(length)
        except (OSError, OverflowError, ValueError) as error:
            raise RecordingError(f"{self.path}: {getattr(error, 'strerror', '') or error}") from None


def in_time_order(streams: Iterable[tuple[int, Callable[[], Iterator[Recorded]]]]) -> Iterator[Recorded]:
    """Yield the messages of several streams by their times.

    Of each stream: its first time, and what opens it when that has come.
    """
    due = sorted(streams, key=lambda stream: stream[0], reverse=True)
    heap: list[tuple[int, int, Recorded, Iterator[Recorded]]] = []
    turn = 0
    while due or heap:
        while due and (not heap or due[-1][0] <= heap[0][0]):
            opened = due.pop()[1]()
            turn += 1
            if (first := next(opened, None)) is not None:
                heapq.heappush(heap, (first.log_ns, turn, first, opened))
        if not heap:
            continue
        _, number, message, stream = heap[0]
        yield message
        if (following := next(stream, None)) is None:
            heapq.heappop(heap)
        else:
            heapq.heapreplace(heap, (following.log_ns, number, following, stream))


def missing_before(metadata: dict[str, dict[str, str]]) -> int:
    """Return how many messages were missing when this copy was made, by its metadata."""
    return sum(number_in(metadata.get(name, {}), MISSING) for name in (DAMAGE, OLD_COPY))


def _indexed(index: ChunkIndex) -> Chunk:
    channels = frozenset(index.message_index_offsets)
    entries = index.message_index_length - INDEX.size * len(channels)
    return Chunk(
        index.message_start_time,
        index.message_end_time,
        index.chunk_start_offset,
        index.chunk_length,
        channels,
        entries // _INDEX_ENTRY,
    )


def _with_own_topic(message: Recorded) -> Recorded:
    if message.channel.topic != OLD_OTHER:
        return message
    channel, payload = with_own_topic(message.channel, message.payload)
    return Recorded(channel, message.sequence, message.log_ns, message.publish_ns, payload)
