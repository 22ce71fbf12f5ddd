"""Writes an MCAP file so that a process that is killed loses what it has not flushed, and nothing else. Pure."""

import secrets
import zlib
from collections.abc import Mapping
from typing import Final, Protocol

from pebble.recordings.files import mcap
from pebble.recordings.files.mcap import Channel, ChunkIndex, Metadata, Op, Packer, Schema, Statistics
from pebble.version import __version__

LIBRARY: Final = f"pebble {__version__}"
CHUNK_BYTES: Final = 1 << 20  # of records, before they are compressed
#: A damaged chunk must not take the names of channels with it: while a channel is used it is written again after a
#: second, then after two, four, and at last once a minute.
_REPEAT_NS, _REPEAT_MOST_NS = 10**9, 60 * 10**9


class Sink(Protocol):
    """Where the bytes go: an unbuffered file. ``write`` may take a part of them."""

    def write(self, data: memoryview, /) -> int | None: ...


class Spool:
    """Records that are needed at the end only. Those of an hour take 0.4 times as much so, and no block for each."""

    def __init__(self) -> None:
        self._compress = zlib.compressobj(1, wbits=11, memLevel=4)  # 16 KB of its own: a fleet has many files
        self._packed = bytearray()
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def append(self, record: bytes) -> None:
        self._packed += self._compress.compress(record)
        self._count += 1

    def records(self) -> bytes:
        """All, one after the other."""
        return zlib.decompress(self._packed + self._compress.copy().flush())


class Contents:
    """What the summary of a file says about its data."""

    def __init__(self) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.metadata: list[tuple[Metadata, int]] = []  # and where each is
        self.attachments: list[bytes] = []  # their indexes, packed
        self.counts: dict[int, int] = {}
        self.messages = self.first_ns = self.last_ns = 0

    def count(self, channel: int, log_ns: int) -> None:
        self.counts[channel] = self.counts.get(channel, 0) + 1
        self.first_ns = log_ns if not self.messages else min(self.first_ns, log_ns)
        self.last_ns = max(self.last_ns, log_ns)
        self.messages += 1

    def end(self, at: int, chunks: int, indexes: bytes) -> bytes:
        """What follows the data, which end at ``at``, in so many chunks with these records about them."""
        statistics = Statistics(
            self.messages,
            len(self.schemas),
            len(self.channels),
            len(self.metadata),
            chunks,
            self.first_ns,
            self.last_ns,
            self.counts,
            len(self.attachments),
        )
        groups = (
            (Op.SCHEMA, [schema.pack() for schema in self.schemas.values()]),
            (Op.CHANNEL, [channel.pack() for channel in self.channels.values()]),
            (Op.STATISTICS, [statistics.pack()]),
            (Op.CHUNK_INDEX, [indexes]),
            (Op.ATTACHMENT_INDEX, self.attachments),
            (Op.METADATA_INDEX, [mcap.metadata_index(metadata, where) for metadata, where in self.metadata]),
        )
        return mcap.end(at, groups)


class McapWriter:
    """One file. :meth:`flush` it at least once a second, and :meth:`finish` it."""

    def __init__(self, sink: Sink, *, library: str, packer: Packer | None = None) -> None:
        self.contents = Contents()
        self.size = 0  # bytes that the sink has taken
        self.flushed = 0  # messages that it has taken
        self._sink, self._packer = sink, packer or Packer()
        self._declare_at: dict[int, int] = {}  # by channel; log time
        self._declared: dict[int, int] = {}  # how often
        self._records: list[bytes] = []  # of the chunk that is being made
        self._records_size = 0
        self._index: dict[int, list[tuple[int, int]]] = {}
        self._chunks = Spool()  # of the chunks that were written
        self._start_ns = self._end_ns = 0
        file = secrets.token_hex(8)
        self._file = self.contents.channels[self.channel(mcap.FILE_TOPIC, "", {mcap.FILE: file})]
        self._write(mcap.header(library, file))

    def metadata(self, name: str, items: Mapping[str, str]) -> None:
        """Add named texts about the file."""
        self._cut()
        metadata = Metadata(name, items)
        self.contents.metadata.append((metadata, self.size))
        self._write(metadata.pack())

    def attach(self, attachment: bytes) -> None:
        """Add the record of an attachment as it is. Raises DamageError."""
        self._cut()
        self.contents.attachments.append(mcap.attachment_index(attachment, self.size))
        self._write(attachment)

    def schema(self, name: str, encoding: str, data: bytes) -> int:
        """Declare what messages look like; returns its number for :meth:`channel`."""
        schema = Schema(len(self.contents.schemas) + 1, name, encoding, data)
        self.contents.schemas[schema.id] = schema
        return schema.id

    def channel(self, topic: str, encoding: str, metadata: Mapping[str, str], schema: int = 0) -> int:
        """Declare a channel; returns its number for :meth:`add`."""
        channel = Channel(len(self.contents.channels) + 1, topic, encoding, dict(metadata), schema)
        self.contents.channels[channel.id] = channel
        self._declare_at[channel.id] = self._declared[channel.id] = 0
        return channel.id

    def add(self, channel: int, log_ns: int, payload: bytes, publish_ns: int = 0) -> None:
        """Add a message that was received at ``log_ns``. Hot."""
        if not self._records:
            self._put(self._file.pack())
        if log_ns >= self._declare_at[channel]:
            self._declare(channel, log_ns)
        entry = log_ns, self._records_size
        entries = self._index.get(channel)
        if entries is None:
            self._index[channel] = [entry]
        else:
            entries.append(entry)
        if self._start_ns == 0 or log_ns < self._start_ns:
            self._start_ns = log_ns
        if log_ns > self._end_ns:
            self._end_ns = log_ns
        self._put(mcap.message(channel, self.contents.messages, log_ns, publish_ns, payload))
        self.contents.count(channel, log_ns)
        if self._records_size >= CHUNK_BYTES:
            self._cut()

    def flush(self) -> None:
        """Give all that was added to the sink."""
        self._cut()

    def finish(self) -> None:
        """Write the summary: the file is complete."""
        self._cut()
        self._write(self.contents.end(self.size, len(self._chunks), self._chunks.records()))

    def _declare(self, channel: int, log_ns: int) -> None:
        one = self.contents.channels[channel]
        if one.schema:
            self._put(self.contents.schemas[one.schema].pack())
        self._put(one.pack())
        self._declare_at[channel] = log_ns + min(_REPEAT_NS << self._declared[channel], _REPEAT_MOST_NS)
        self._declared[channel] += 1

    def _put(self, record: bytes) -> None:
        self._records.append(record)
        self._records_size += len(record)

    def _cut(self) -> None:
        """Write the records as one chunk."""
        if not self._records:
            return
        records, at = b"".join(self._records), self.size
        chunk = mcap.chunk(records, self._start_ns, self._end_ns, self._packer)
        where, indexes, parts = at + len(chunk), {}, []
        for channel, entries in self._index.items():
            parts.append(mcap.message_index(channel, entries))
            indexes[channel] = where
            where += len(parts[-1])
        packed = len(chunk) - (mcap.HEAD.size + mcap.CHUNK.size + 4 + len(self._packer.name) + 8)
        start, end, length = self._start_ns, self._end_ns, where - at - len(chunk)
        self._records, self._records_size, self._index, self._start_ns, self._end_ns = [], 0, {}, 0, 0
        self._write(chunk)
        self.flushed = self.contents.messages
        self._write(b"".join(parts))
        index = ChunkIndex(start, end, at, len(chunk), indexes, length, self._packer.name, packed, len(records))
        self._chunks.append(index.pack())

    def _write(self, data: bytes) -> None:
        rest = memoryview(data)
        while rest:
            taken = self._sink.write(rest)
            rest = rest[taken:]
        self.size += len(data)
