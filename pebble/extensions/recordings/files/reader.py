"""A reader of MCAP files in any state: it reads what can be read, and reports how much is missing.

A finished file is read by its summary. Without one (the file is being written, its recorder was killed, or its end is
damaged) its records are scanned once. After damage, reading continues at the next chunk with the right checksum.
"""

from __future__ import annotations

import heapq
import os
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from functools import lru_cache, partial
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from pebble.extensions.recordings.files.recorded import (
    ACTIVE,
    FOREVER_NS,
    UNNAMED,
    Channel,
    Damage,
    DamageError,
    Recorded,
    RecordingError,
    Schema,
    require_package,
)
from pebble.extensions.recordings.files.records import (
    CHUNK,
    HEAD,
    INDEX,
    LARGEST_RECORD,
    MAGIC,
    MESSAGE,
    Op,
    record_of,
    records,
    summary_of,
    unpack_chunk,
)
from pebble.extensions.recordings.files.scan import INDEX_ENTRY, Scan
from pebble.ownership import open_plain

if TYPE_CHECKING:
    from mcap.records import ChunkIndex, McapRecord, Statistics
    from mcap.summary import Summary

DAMAGE: Final = "pebble.damage"  # metadata of a copy of a file of which a part was missing
MISSING: Final = "missing_messages"  # an item of this metadata

_LARGEST_SUMMARY: Final = 256 << 20
_TAIL, _CHECKSUM = 37, 4  # bytes: of a footer and what follows it, of the checksum in it
_KEPT: Final = 4  # unpacked chunks: the next question is mostly about the same time
_time = attrgetter("log_ns")

Chooses = Callable[[Channel], bool]


class Chunk(NamedTuple):
    """The position and contents of a chunk; ``channels`` empty: unknown, so it may hold any channel."""

    start_ns: int
    end_ns: int
    at: int
    length: int  # with its head
    channels: frozenset[int] = frozenset()
    messages: int = 0  # 0: not known


class RecordingFile:
    """A file, finished or not. Not thread-safe. Each method raises RecordingError."""

    def __init__(self, path: Path) -> None:
        require_package()
        self.path, self.damage = path, Damage()
        self.channels: dict[int, Channel] = {}
        self.chunks: list[Chunk] = []
        self.is_ours = True  # written by Pebble, which numbers messages; also if a damaged header does not tell
        self.statistics: Statistics | None = None  # None: the file is not finished, or its summary is incomplete
        self._schemas: dict[int, Schema] = {}
        self._metadata: list[int] = []  # positions of the records of metadata
        self._scan = Scan(self._read, self.damage)  # of all records, for a file without a usable summary
        #: Returns a chunk's messages of all channels; the newest few chunks stay in memory.
        self._recent = lru_cache(_KEPT)(partial(self._unpacked, chooses=lambda _channel: True))
        try:
            self._file = open_plain(path)
        except OSError as error:
            raise RecordingError(f"{path}: {error.strerror or error}") from None
        self._opened_size = self.size
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
        """Return the time of the first message; 0 if there is none."""
        return min((chunk.start_ns for chunk in self.chunks if chunk.start_ns), default=0)

    @property
    def last_ns(self) -> int:
        return max((chunk.end_ns for chunk in self.chunks), default=0)

    @property
    def size(self) -> int:
        return os.fstat(self._file.fileno()).st_size

    def is_replaced(self) -> bool:
        """True if the file's name leads to another file now, or if a finished file has grown. Raises OSError."""
        now = self.path.stat()
        has_grown = now.st_size != self._opened_size and not self.path.name.endswith(ACTIVE)
        return has_grown or not os.path.samestat(now, os.fstat(self._file.fileno()))

    @property
    def is_cut_off(self) -> bool:
        """True if the file ends in the middle of a record or in zeros, as after a kill."""
        return self._scan.is_cut_off

    @property
    def problem(self) -> str:
        """Return the unreadable parts, in words; "" if everything that was read so far was intact."""
        return self.damage.report(active=self.path.name.endswith(ACTIVE))

    def reaches_into(self, since_ns: int, until_ns: int) -> bool:
        """True if the file may hold messages of a period; an unfinished file has no end."""
        ends = self.damage.finished and self.last_ns < since_ns
        return bool(self.chunks) and self.first_ns < until_ns and not ends

    def refresh(self) -> None:
        """Find records that were written since the last call. A finished file does not change."""
        if self.statistics is None:
            self._look_through()

    def read(
        self, *, chooses: Chooses = lambda _channel: True, since_ns: int = 0, until_ns: int = FOREVER_NS
    ) -> Iterator[Recorded]:
        """Yield the messages of the channels that ``chooses`` accepts, in the order of time.

        Damage is noted in :attr:`damage`. Chunks outside the period are skipped; some messages outside it may come.
        """
        chunks = [chunk for chunk in self.chunks if chunk.end_ns >= since_ns and chunk.start_ns < until_ns]
        if any(chunk.end_ns > next_.start_ns for chunk, next_ in pairwise(chunks)):  # other programs write in any order
            streams = ((chunk.start_ns, partial(self._unpacked_later, chunk, chooses)) for chunk in chunks)
            yield from in_time_order(streams)
            return
        expected = 0 if len(chunks) == len(self.chunks) else None  # number of the next message; None: some are skipped
        for chunk in chunks:
            messages, numbers = self._unpacked(chunk, chooses)
            if numbers is not None:  # sequence numbers, which count all messages of the file, chosen or not
                first, last = numbers
                if expected is not None and self.statistics is None:  # without a summary only this gap shows the loss
                    self.damage.missing += max(0, first - expected)
                expected = last + 1
            elif expected is not None:  # a damaged chunk: its messages are counted as missing already
                expected += chunk.messages
            yield from messages

    def messages(self, chunk: Chunk) -> list[Recorded]:
        """Return the messages of one chunk in the order of time; empty if the chunk is damaged."""
        return self._recent(chunk)[0]

    def metadata(self) -> dict[str, dict[str, str]]:
        """Return the file's metadata by name; of several with one name the last."""
        from mcap.records import Metadata

        by_name: dict[str, dict[str, str]] = {}
        for at in self._metadata:
            try:
                record = self._record(at)
            except DamageError as error:
                self.damage.add(at, error)
                continue
            if isinstance(record, Metadata):
                by_name[record.name] = record.metadata
        return by_name

    # -- a finished file

    def _open(self) -> None:
        """Read the header and the summary; without a usable summary look through all records."""
        from mcap.records import Header

        begin = self._read(0, len(MAGIC))
        if not begin:
            self.damage.why = "it is empty"
        elif begin != MAGIC:
            self.damage.add(0, "it does not begin as MCAP does")
        with suppress(DamageError):
            header = self._record(len(MAGIC))
            self.is_ours = not isinstance(header, Header) or header.library.startswith("pebble")
        summary = self._summary()
        if summary is not None and self._take_over(summary):
            return
        if not self.is_ours:
            raise RecordingError(
                f"{self.path}: another program wrote it, and its end is missing, or has no index of its messages: "
                "`mcap recover` makes a copy that has"
            )
        self._look_through()

    def _summary(self) -> Summary | None:
        """Return the summary; None if the file is unfinished, its end is damaged, or it has none."""
        from mcap.records import Footer

        tail = self._read(max(0, self.size - _TAIL), _TAIL)
        with suppress(DamageError):
            footer = record_of(tail[: -len(MAGIC)])
            if not isinstance(footer, Footer) or not tail.endswith(MAGIC):
                return None
            start = footer.summary_start or self.size - _TAIL  # 0: the footer follows without a summary
            end = self._read(start, _LARGEST_SUMMARY)
            has_checksum = footer.summary_crc != 0
            if not has_checksum or zlib.crc32(end[: -len(MAGIC) - _CHECKSUM]) == footer.summary_crc:
                self.damage.finished = True
                return summary_of(end)
        return None

    def _take_over(self, summary: Summary) -> bool:
        """Use the summary; False if it does not cover all messages, as in files of other programs."""
        # A chunk without an index of messages is left out: it has none, or the count below is not the file's.
        chunks = [_chunk_of(index) for index in summary.chunk_indexes if index.message_index_offsets]
        counted = summary.statistics
        if counted is None or counted.message_count != sum(chunk.messages for chunk in chunks):
            return False
        if not counted.channel_message_counts.keys() <= summary.channels.keys():
            return False
        for record in (*summary.schemas.values(), *summary.channels.values()):
            self._declare(record)
        self._metadata = [index.offset for index in summary.metadata_indexes]
        self.chunks, self.statistics = chunks, counted
        return True

    # -- an unfinished file

    def _look_through(self) -> None:
        """Find chunks and channels, from where the last scan ended."""
        for op, at, end, channels, messages in self._scan.records(self.size):
            if op == Op.CHUNK:
                start_ns, end_ns, *_ = CHUNK.unpack(self._read(at + HEAD.size, CHUNK.size))
                chunk = Chunk(start_ns, end_ns, at, end - at, channels, messages)
                self.chunks.append(chunk)
                all_known = bool(channels) and channels <= self.channels.keys()  # no channels: an index is damaged
                if not all_known:
                    self._learn(chunk)
            elif op == Op.METADATA:
                self._metadata.append(at)
            elif op == Op.CHANNEL:
                self._declare(self._record(at), is_certain=False)  # outside of chunks no checksum protects it

    def _learn(self, chunk: Chunk) -> None:
        """Note the channels that a chunk declares."""
        try:
            for _ in self._message_records(chunk):  # notes them
                pass
        except DamageError as error:
            self.damage.add(chunk.at, error, chunk.messages)

    # -- both

    def _unpacked(self, chunk: Chunk, chooses: Chooses) -> tuple[list[Recorded], tuple[int, int] | None]:
        """Return the chosen messages of a chunk, and the sequence numbers of its first and last message.

        None in place of the numbers: the chunk is damaged, or has no message.
        """
        messages: list[Recorded] = []
        first, last = -1, -1
        chosen: dict[int, Channel | None] = {}  # by channel number; None: not chosen
        try:
            for data, begin, end in self._message_records(chunk):
                number, sequence, log_ns, publish_ns = MESSAGE.unpack_from(data, begin)
                if first < 0:
                    first = sequence
                last = sequence
                if number not in chosen:
                    channel = self.channels.get(number) or Channel(number, f"{UNNAMED}{number}", "")
                    chosen[number] = channel if chooses(channel) else None
                if number not in self.channels:
                    self.damage.unnamed += 1
                if (chosen_channel := chosen[number]) is not None:
                    payload = data[begin + MESSAGE.size : end]
                    messages.append(Recorded(chosen_channel, sequence, log_ns, publish_ns, payload))
        except DamageError as error:
            self.damage.add(chunk.at, error, chunk.messages)
            return [], None
        messages.sort(key=_time)
        return messages, (first, last) if first >= 0 else None

    def _message_records(self, chunk: Chunk) -> Iterator[tuple[bytes, int, int]]:
        """Yield the data of a chunk with the begin and end of each message; note its channels. Raises DamageError."""
        if chunk.length >= LARGEST_RECORD:
            raise DamageError("a chunk is damaged")
        data = unpack_chunk(self._read(chunk.at, chunk.length))
        for op, begin, end in records(data):
            if op == Op.MESSAGE:
                yield data, begin, end
            elif op in (Op.SCHEMA, Op.CHANNEL):
                self._declare(record_of(data[begin - HEAD.size : end]))

    def _unpacked_later(self, chunk: Chunk, chooses: Chooses) -> Iterator[Recorded]:
        yield from self._unpacked(chunk, chooses)[0]

    def _declare(self, record: McapRecord, *, is_certain: bool = True) -> None:
        """Note a schema or channel. Channels that were noted before keep their schema.

        ``is_certain`` False: it was outside of chunks, where no checksum protects it; such a channel replaces no other.
        """
        from mcap.records import Channel as ChannelRecord
        from mcap.records import Schema as SchemaRecord

        if isinstance(record, SchemaRecord):
            self._schemas[record.id] = Schema(record.name, record.encoding, record.data)
        elif isinstance(record, ChannelRecord) and (is_certain or record.id not in self.channels):
            schema = self._schemas.get(record.schema_id)
            channel = Channel(record.id, record.topic, record.message_encoding, record.metadata, schema)
            self.channels[record.id] = channel

    def _record(self, at: int) -> McapRecord:
        """Return the record at a position outside of chunks. Raises DamageError."""
        head = self._read(at, HEAD.size)
        length = HEAD.unpack(head)[1] if len(head) == HEAD.size else LARGEST_RECORD
        if length >= LARGEST_RECORD:
            raise DamageError("a record is cut off, or of a size that cannot be")
        return record_of(self._read(at, HEAD.size + length))

    def _read(self, at: int, length: int) -> bytes:
        try:
            self._file.seek(at)
            return self._file.read(length)
        except (OSError, OverflowError, ValueError) as error:
            raise RecordingError(f"{self.path}: {getattr(error, 'strerror', '') or error}") from None


def in_time_order(streams: Iterable[tuple[int, Callable[[], Iterator[Recorded]]]]) -> Iterator[Recorded]:
    """Yield the messages of several streams in the order of time.

    ``streams``: each with its first time and a function that opens it; it is opened when that time has come.
    """
    unopened = sorted(streams, key=lambda stream: stream[0], reverse=True)  # the earliest last
    #: Of each open stream: the next message's time, the stream's number (the lower is first), the message, the stream.
    heap: list[tuple[int, int, Recorded, Iterator[Recorded]]] = []
    opened = 0
    while unopened or heap:
        while unopened and (not heap or unopened[-1][0] <= heap[0][0]):
            _, open_stream = unopened.pop()
            stream = open_stream()
            opened += 1
            if (first := next(stream, None)) is not None:
                heapq.heappush(heap, (first.log_ns, opened, first, stream))
        if not heap:
            continue
        _, number, message, stream = heap[0]
        yield message
        if (following := next(stream, None)) is None:
            heapq.heappop(heap)
        else:
            heapq.heapreplace(heap, (following.log_ns, number, following, stream))


def missing_before(metadata: dict[str, dict[str, str]]) -> int:
    """Return how many messages were already missing when this copy was made, by its metadata."""
    text = metadata.get(DAMAGE, {}).get(MISSING, "")
    return int(text) if text.isascii() and text.isdigit() and len(text) < 18 else 0


def _chunk_of(index: ChunkIndex) -> Chunk:
    """Return a chunk as the summary describes it."""
    channels = frozenset(index.message_index_offsets)
    # Behind the chunk there is an index for each channel: a head, and an entry for each message.
    entries = index.message_index_length - INDEX.size * len(channels)
    return Chunk(
        index.message_start_time,
        index.message_end_time,
        index.chunk_start_offset,
        index.chunk_length,
        channels,
        entries // INDEX_ENTRY,
    )
