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
from functools import partial
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from pebble.extensions.recordings.files.recorded import (
    ACTIVE,
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
from pebble.extensions.recordings.files.records import (
    CHUNK,
    FOOTER,
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
    with_own_topic,
)
from pebble.extensions.recordings.files.scan import Found, Scan
from pebble.ownership import open_plain

if TYPE_CHECKING:
    from mcap.records import Attachment, ChunkIndex, McapRecord, Metadata, Statistics
    from mcap.summary import Summary

DAMAGE, MISSING = "pebble.damage", "missing_messages"  # metadata of a copy of a file of which a part was missing
#: Names of the last version: of that metadata, and of the channel of topics for which a file had no room.
OLD_COPY, OLD_OTHER = "pebble.rewritten", "$recorder/other"

_INDEX_ENTRY: Final = 16  # bytes
_LARGEST_HEADER: Final = 1 << 16
_LARGEST_SUMMARY: Final = 256 << 20
_MOST_OPEN: Final = 512 << 20  # bytes of chunks that are sorted at the same time
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
        self.is_ours = True  # and its messages are numbered
        self.statistics: Statistics | None = None  # None: it is not finished, or does not say all
        self._schemas: dict[int, Schema] = {}
        self._names: dict[int, Channel] = {}  # channels that are named beside chunks, where no checksum protects them
        self._beside: list[int] = []  # where metadata and attachments are
        self._indexed: dict[int, int] | None = None  # messages by channel of the last chunk, while its indexes may come
        self._indexed_to = 0  # where these end
        self._looked_everywhere = False
        try:
            self._file = open_plain(path)
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
        """Return the time of the first message; 0 if there is none."""
        return min((chunk.start_ns for chunk in self.chunks if chunk.start_ns), default=0)

    @property
    def last_ns(self) -> int:
        return max((chunk.end_ns for chunk in self.chunks), default=0)

    @property
    def size(self) -> int:
        return os.fstat(self._file.fileno()).st_size

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
        """Return the messages of one chunk in the order of time; empty if the chunk is damaged."""
        return self._unpacked(chunk, chooses)[0]

    def metadata(self) -> dict[str, dict[str, str]]:
        """Return the file's metadata by name; of several with one name the last."""
        from mcap.records import Metadata

        return {record.name: record.metadata for record in self.beside() if isinstance(record, Metadata)}

    def beside(self) -> Iterator[Metadata | Attachment]:
        """Yield the file's metadata and attachments."""
        from mcap.records import Attachment, Metadata

        for at in self._beside:
            head = self._read(at, HEAD.size)
            length = HEAD.unpack(head)[1] if len(head) == HEAD.size else LARGEST_RECORD
            try:
                if length >= LARGEST_RECORD:
                    raise DamageError("metadata, or an attachment, of a size that cannot be")
                record = record_of(self._read(at, HEAD.size + length))
            except DamageError as error:
                self.damage.add(at, error)
                continue
            if isinstance(record, Metadata | Attachment):
                yield record

    # -- a finished file

    def _open(self) -> None:
        from mcap.records import Header

        begin = self._read(0, _LARGEST_HEADER)
        if not begin:
            self.damage.why = "it is empty"
        elif not begin.startswith(MAGIC):
            self.damage.add(0, "it does not begin as MCAP does")
        with suppress(DamageError):
            header = record_of(begin[len(MAGIC) :])
            self.is_ours = not isinstance(header, Header) or header.library.startswith("pebble")
        self._scan = Scan(self.path, self._read, self.damage, is_ours=self.is_ours)
        summary = self._summary()
        if summary is None or not self._take_over(summary):
            self._look_through()

    def _summary(self) -> Summary | None:
        """Return the summary; None if the file is unfinished, its end is damaged, or it has none."""
        tail = FOOTER.size + len(MAGIC)
        file_size = self.size
        footer = self._read(max(0, file_size - tail), tail)
        if len(footer) < tail or footer[FOOTER.size :] != MAGIC:
            return None
        op, length, start, _, checksum = FOOTER.unpack_from(footer)
        size = file_size - start if start else tail
        if op != Op.FOOTER or length != FOOTER.size - HEAD.size or not tail <= size <= _LARGEST_SUMMARY:
            return None
        end = self._read(file_size - size, size)
        if checksum and zlib.crc32(end[: -len(MAGIC) - 4]) != checksum:
            return None
        self.damage.finished = True
        try:
            return summary_of(end)
        except DamageError:
            return None

    def _take_over(self, summary: Summary) -> bool:
        """Use the summary; False if it does not cover all messages, as in files of other programs."""
        chunks = [_indexed(index) for index in summary.chunk_indexes if index.message_index_offsets]
        counted = summary.statistics
        if counted is None or counted.message_count != sum(chunk.messages for chunk in chunks):
            return False
        if not counted.channel_message_counts.keys() <= summary.channels.keys():
            return False
        for record in (*summary.schemas.values(), *summary.channels.values()):
            self._name(record, self.channels)
        self._beside = [index.offset for index in summary.metadata_indexes]
        self._beside += [index.offset for index in summary.attachment_indexes]
        self.chunks, self.statistics = chunks, counted
        return True

    # -- one that is not

    def _look_through(self) -> None:
        """Find chunks and channels, from where the last scan ended."""
        for record in self._scan.records(self.size):
            if record.op == Op.MESSAGE_INDEX:
                self._take_index(record)
                continue
            self._take_indexes(are_all=record.at == self._indexed_to)
            self._indexed = None
            at, begin = record.at, record.at + HEAD.size
            if record.op == Op.CHUNK:
                start_ns, end_ns, *_ = CHUNK.unpack(self._read(begin, CHUNK.size))
                self.chunks.append(Chunk(start_ns, end_ns, at, record.end - at))
                self._indexed, self._indexed_to = {}, record.end
            elif record.op in (Op.METADATA, Op.ATTACHMENT):
                self._beside.append(at)
            elif record.op in (Op.SCHEMA, Op.CHANNEL):
                try:
                    self._declare(self._read(at, record.end - at), self._names)
                except DamageError as error:
                    self.damage.add(at, error)

        self._take_indexes(are_all=False)

    def _take_index(self, record: Found) -> None:
        """Count the messages of a channel in the last chunk, unless damage lies between."""
        entries = record.end - record.at - INDEX.size
        if self._indexed is not None and record.at == self._indexed_to and entries >= 0:
            channel = INDEX.unpack(self._read(record.at, INDEX.size))[2]
            self._indexed[channel] = entries // _INDEX_ENTRY
            self._indexed_to = record.end

    def _take_indexes(self, *, are_all: bool) -> None:
        """Note the contents of the last chunk. ``are_all``: no index of it is damaged or still unwritten."""
        indexed = self._indexed
        if indexed is None:
            return
        channels = frozenset(indexed if are_all else ())
        chunk = self.chunks[-1] = self.chunks[-1]._replace(channels=channels, messages=sum(indexed.values()))
        if not indexed or not indexed.keys() <= self.channels.keys():
            self._learn(chunk)

    def _learn(self, chunk: Chunk) -> None:
        """Read the channels that a chunk declares."""
        try:
            data = self._records(chunk)
            for op, begin, end in records(data):
                if op != Op.MESSAGE:
                    self._declare(data[begin - HEAD.size : end], self.channels)
        except DamageError as error:
            self.damage.add(chunk.at, error, chunk.messages)
            return
        for number in self._names.keys() - self.channels.keys():
            if not chunk.channels or number in chunk.channels:
                self.channels[number] = self._names[number]

    # -- both

    def _unpacked(self, chunk: Chunk, chooses: Chooses) -> tuple[list[Recorded], tuple[int, int] | None]:
        """Return the chosen messages of a chunk, and the sequence numbers of its first and last message."""
        messages: list[Recorded] = []
        first, last = -1, -1
        chosen: dict[int, Channel | None] = {}  # by channel number; None: not chosen
        unnamed: set[int] = set()
        try:
            data = self._records(chunk)
            for op, begin, end in records(data):
                if op != Op.MESSAGE:
                    self._declare(data[begin - HEAD.size : end], self.channels)
                    continue
                channel_number, sequence, log_ns, publish_ns = MESSAGE.unpack_from(data, begin)
                first, last = sequence if first < 0 else first, sequence
                if channel_number not in chosen:
                    channel = self._channel(channel_number)
                    if channel_number not in self.channels:
                        unnamed.add(channel_number)
                    chosen[channel_number] = channel if channel.topic == OLD_OTHER or chooses(channel) else None
                if channel_number in unnamed:
                    self.damage.unnamed += 1
                channel_or_none = chosen[channel_number]
                if channel_or_none is not None:
                    messages.append(
                        Recorded(channel_or_none, sequence, log_ns, publish_ns, data[begin + MESSAGE.size : end])
                    )
            # Old files have all topics without a channel on one: they are chosen by the topic inside the message.
            if any(channel is not None and channel.topic == OLD_OTHER for channel in chosen.values()):
                messages = [message for message in map(_with_own_topic, messages) if chooses(message.channel)]
        except DamageError as error:
            self.damage.add(chunk.at, error, chunk.messages)
            return [], None
        messages.sort(key=_time)
        return messages, (first, last) if first >= 0 else None

    def _opened(self, chunk: Chunk, chooses: Chooses, opened: list[int]) -> Iterator[Recorded]:
        opened[0] += chunk.length
        if opened[0] > _MOST_OPEN:
            raise RecordingError(
                f"{self.path}: over {_MOST_OPEN >> 20} MB of it are not in the order of time: `mcap sort` puts them so"
            )
        yield from self.messages(chunk, chooses)
        opened[0] -= chunk.length

    def _declare(self, data: bytes, channels: dict[int, Channel]) -> None:
        """Add a schema or channel from its record. Raises DamageError."""
        if data[0] in (Op.SCHEMA, Op.CHANNEL):
            self._name(record_of(data), channels)

    def _name(self, record: McapRecord, channels: dict[int, Channel]) -> None:
        from mcap.records import Channel as ChannelRecord
        from mcap.records import Schema as SchemaRecord

        if isinstance(record, SchemaRecord):
            self._schemas.setdefault(record.id, Schema(record.name, record.encoding, record.data))
        elif isinstance(record, ChannelRecord):
            schema = self._schemas.get(record.schema_id)
            channel = Channel(record.id, record.topic, record.message_encoding, record.metadata, schema)
            channels.setdefault(record.id, channel)

    def _channel(self, number: int) -> Channel:
        """Return the channel of this number from any place that declares it, as the first such chunk may be lost."""
        if number not in self.channels and number in self._names:
            self.channels[number] = self._names[number]
        if number not in self.channels and not self._looked_everywhere:
            self._looked_everywhere = True
            for chunk in self.chunks:
                self._learn(chunk)
        return self.channels.get(number) or unnamed(number)

    def _records(self, chunk: Chunk) -> bytes:
        """Return the records of a chunk. Raises DamageError."""
        head = self._read(chunk.at, HEAD.size if chunk.length < LARGEST_RECORD else 0)
        if len(head) < HEAD.size or HEAD.unpack(head) != (Op.CHUNK, chunk.length - HEAD.size):
            raise DamageError("a chunk is damaged")
        return unpack_chunk(self._read(chunk.at + HEAD.size, chunk.length - HEAD.size))

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
    """Return how many messages were already missing when this copy was made, by its metadata."""
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
