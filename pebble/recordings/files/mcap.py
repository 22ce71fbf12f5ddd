"""The records of MCAP files that recordings use, byte by byte: https://mcap.dev/spec. Pure."""

from __future__ import annotations

import importlib
import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cache
from typing import Any, Final

import msgspec

from pebble.errors import PebbleError

MAGIC: Final = b"\x89MCAP0\r\n"
#: Of a chunk, unpacked: ours are about 1 MB, and hold one message more than that.
LARGEST_CHUNK: Final = 64 << 20
LARGEST_PAYLOAD: Final = 16 << 20  # that the recorder writes


class Op(IntEnum):
    """What a record is. Readers skip numbers that they do not know; those from 0x80 on are free for use."""

    HEADER = 0x01
    FOOTER = 0x02
    SCHEMA = 0x03
    CHANNEL = 0x04
    MESSAGE = 0x05
    CHUNK = 0x06
    MESSAGE_INDEX = 0x07
    CHUNK_INDEX = 0x08
    ATTACHMENT = 0x09
    ATTACHMENT_INDEX = 0x0A
    STATISTICS = 0x0B
    METADATA = 0x0C
    METADATA_INDEX = 0x0D
    SUMMARY_OFFSET = 0x0E
    DATA_END = 0x0F
    PADDING = 0x80  # ours: covers damaged bytes


#: The channel of messages whose topics have none of their own: :func:`pack_other`.
OTHER: Final = "$recorder/other"
#: A channel without messages. Its metadata name the file.
FILE_TOPIC: Final = "$recorder/file"
FILE: Final = "file"
_DIGITS: Final = 18  # of a number in metadata
_LARGEST_SUMMARY: Final = 256 << 20
_NAME_LENGTH: Final = 16  # hexadecimal digits
_HEXADECIMAL: Final = frozenset("0123456789abcdef")

HEAD: Final = struct.Struct("<BQ")  # opcode, length of what follows
MESSAGE: Final = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
CHUNK: Final = struct.Struct("<QQQI")  # first and last log time, unpacked size, checksum
_MESSAGE_HEAD: Final = struct.Struct("<BQHIQQ")
_U16, _U32, _U64 = struct.Struct("<H"), struct.Struct("<I"), struct.Struct("<Q")
_PAIR: Final = struct.Struct("<QQ")
_OFFSET: Final = struct.Struct("<HQ")
_STATISTICS: Final = struct.Struct("<QHIIIIQQ")
_FOOTER: Final = struct.Struct("<QQI")


class RecordingError(PebbleError):
    """A file that cannot be read as a recording. Example: ``walk.mcap: No such file or directory``."""


class UnreadableError(RecordingError):
    """What is in a file is not damaged, but cannot be read here. Example: ``a chunk is compressed by lz4: …``."""


class DamageError(PebbleError):
    """Bytes that are not the record they should be. Example: ``a chunk's checksum is wrong``."""


@dataclass(frozen=True, slots=True)
class Schema:
    """What the messages of a channel look like: data for their encoding, a set of Protobuf descriptors."""

    id: int
    name: str
    encoding: str
    data: bytes

    def pack(self) -> bytes:
        body = _U16.pack(self.id) + _text(self.name) + _text(self.encoding) + _U32.pack(len(self.data)) + self.data
        return record(Op.SCHEMA, body)

    @classmethod
    def unpack(cls, body: bytes) -> Schema:
        """Raises DamageError."""
        with _Reading(body) as reading:
            return cls(reading.u16(), reading.text(), reading.text(), reading.take(reading.u32()))


@dataclass(frozen=True, slots=True)
class Channel:
    """What the messages of one topic have in common; several channels may share a topic."""

    id: int
    topic: str
    encoding: str  # of its messages: json, protobuf, application/octet-stream
    metadata: Mapping[str, str] = field(default_factory=dict)
    schema: int = 0  # 0: none
    described: Schema | None = field(default=None, compare=False)  # that schema, if its file has it

    def pack(self) -> bytes:
        body = struct.pack("<HH", self.id, self.schema) + _text(self.topic) + _text(self.encoding)
        return record(Op.CHANNEL, body + _texts(self.metadata))

    @classmethod
    def unpack(cls, body: bytes) -> Channel:
        """Raises DamageError."""
        with _Reading(body) as reading:
            number, schema = reading.u16(), reading.u16()
            return cls(number, reading.text(), reading.text(), reading.texts(), schema)


@dataclass(frozen=True, slots=True)
class Metadata:
    """Named texts about a file."""

    name: str
    items: Mapping[str, str]

    def pack(self) -> bytes:
        return record(Op.METADATA, _text(self.name) + _texts(self.items))

    @classmethod
    def unpack(cls, body: bytes) -> Metadata:
        """Raises DamageError."""
        with _Reading(body) as reading:
            return cls(reading.text(), reading.texts())


class Recorded(msgspec.Struct, frozen=True):
    """One message of a recording."""

    channel: Channel
    sequence: int  # its number in the file, from 0: what is missing is known exactly
    log_ns: int  # when it was received, since 1970
    publish_ns: int  # its own stamp; 0: it has none
    payload: bytes


@dataclass(frozen=True, slots=True)
class ChunkIndex:
    """Where a chunk is, and the indexes of its channels."""

    start_ns: int
    end_ns: int
    at: int
    length: int
    indexes: Mapping[int, int]  # where each channel's index is
    indexes_length: int
    compression: str
    packed_size: int
    size: int

    def pack(self) -> bytes:
        offsets = b"".join(_OFFSET.pack(*item) for item in self.indexes.items())
        body = struct.pack("<QQQQI", self.start_ns, self.end_ns, self.at, self.length, len(offsets)) + offsets
        body += _U64.pack(self.indexes_length) + _text(self.compression) + _PAIR.pack(self.packed_size, self.size)
        return record(Op.CHUNK_INDEX, body)

    @classmethod
    def unpack(cls, body: bytes) -> ChunkIndex:
        """Raises DamageError."""
        with _Reading(body) as reading:
            start, end, at, length = (reading.u64() for _ in range(4))
            offsets = reading.take(reading.u32())
            indexes = dict(_OFFSET.iter_unpack(offsets))
            return cls(start, end, at, length, indexes, reading.u64(), reading.text(), reading.u64(), reading.u64())


@dataclass(frozen=True, slots=True)
class Statistics:
    """What a file holds."""

    messages: int
    schemas: int
    channels: int
    metadata: int
    chunks: int
    first_ns: int
    last_ns: int
    counts: Mapping[int, int]  # of messages, by channel
    attachments: int = 0

    def pack(self) -> bytes:
        counts = b"".join(_OFFSET.pack(*item) for item in self.counts.items())
        numbers = (
            self.messages,
            self.schemas,
            self.channels,
            self.attachments,
            self.metadata,
            self.chunks,
            self.first_ns,
            self.last_ns,
        )
        return record(Op.STATISTICS, _STATISTICS.pack(*numbers) + _U32.pack(len(counts)) + counts)

    @classmethod
    def unpack(cls, body: bytes) -> Statistics:
        """Raises DamageError."""
        with _Reading(body) as reading:
            messages, schemas, channels, attachments, metadata, chunks, first, last = _STATISTICS.unpack(
                reading.take(_STATISTICS.size)
            )
            counts = dict(_OFFSET.iter_unpack(reading.take(reading.u32())))
            return cls(messages, schemas, channels, metadata, chunks, first, last, counts, attachments)


def number_in(items: Mapping[str, str], name: str) -> int:
    """A number in metadata; 0 where there is none."""
    text = items.get(name, "")
    return int(text) if text.isascii() and text.isdigit() and len(text) < _DIGITS else 0


def record(op: Op, body: bytes) -> bytes:
    return HEAD.pack(op, len(body)) + body


def header(library: str, file: str) -> bytes:
    """How a file begins; ``file``: its own name, which its chunks repeat."""
    return MAGIC + record(Op.HEADER, _text("") + _text(f"{library} {file}"))


def file_of_header(body: bytes) -> str | None:
    """The name of a file in its header; None for a file of another program. Raises DamageError."""
    with _Reading(body) as reading:
        reading.text()
        library, _, name = reading.text().rpartition(" ")
    digits = sum(digit in _HEXADECIMAL for digit in name)  # a flipped bit costs one
    is_ours = library.startswith("pebble") and len(name) == _NAME_LENGTH and digits >= _NAME_LENGTH - 1
    return _name(name) if is_ours else None


def file_of_chunk(records: bytes) -> str:
    """The name of its file that a chunk repeats in its first record; "" if it has none.

    By it a chunk inside a payload, which may be a recording, too, is not taken for one of the file.
    """
    if len(records) < HEAD.size or records[0] != Op.CHANNEL:
        return ""
    _, length = HEAD.unpack_from(records)
    try:
        return _name(Channel.unpack(records[HEAD.size : HEAD.size + length]).metadata.get(FILE, ""))
    except DamageError:
        return ""


def message(channel: int, sequence: int, log_ns: int, publish_ns: int, payload: bytes) -> bytes:
    """The record of a message; hot."""
    head = _MESSAGE_HEAD.pack(
        Op.MESSAGE, MESSAGE.size + len(payload), channel, sequence & 0xFFFFFFFF, log_ns, publish_ns
    )
    return head + payload


def pack_other(topic: str, metadata: Mapping[str, str], payload: bytes) -> bytes:
    """A message together with what its channel would say, for :data:`OTHER`."""
    return _text(topic) + _texts(metadata) + payload


def unpack_other(channel: Channel, data: bytes) -> tuple[Channel, bytes]:
    """The channel that a message on :data:`OTHER` would have had, and its payload. Raises DamageError."""
    with _Reading(data) as reading:
        topic, metadata = reading.text(), reading.texts()
        return Channel(channel.id, topic, channel.encoding, {**channel.metadata, **metadata}), reading.rest()


def message_index(channel: int, entries: Iterable[tuple[int, int]]) -> bytes:
    """``entries``: log times, and where the messages are in the unpacked chunk."""
    body = b"".join(_PAIR.pack(*entry) for entry in entries)
    return record(Op.MESSAGE_INDEX, _U16.pack(channel) + _U32.pack(len(body)) + body)


def metadata_index(metadata: Metadata, at: int) -> bytes:
    return record(Op.METADATA_INDEX, _PAIR.pack(at, len(metadata.pack())) + _text(metadata.name))


def attachment_index(attachment: bytes, at: int) -> bytes:
    """``attachment``: its whole record. Raises DamageError."""
    with _Reading(attachment) as reading:
        reading.take(HEAD.size)
        times, name, media_type = reading.take(_PAIR.size), reading.text(), reading.text()
        size = reading.u64()
    body = _PAIR.pack(at, len(attachment)) + times + _U64.pack(size) + _text(name) + _text(media_type)
    return record(Op.ATTACHMENT_INDEX, body)


def end(at: int, groups: Iterable[tuple[Op, list[bytes]]]) -> bytes:
    """The end of a file whose data end at ``at``: DataEnd, the summary, its offsets, the footer."""
    data_end = record(Op.DATA_END, _U32.pack(0))
    at += len(data_end)
    summary = offsets = b""
    for op, records in groups:
        group = b"".join(records)
        if group:
            offsets += record(Op.SUMMARY_OFFSET, struct.pack("<BQQ", op, at + len(summary), len(group)))
            summary += group
    footer = HEAD.pack(Op.FOOTER, _FOOTER.size) + _PAIR.pack(at, at + len(summary))
    checksum = zlib.crc32(summary + offsets + footer)
    return data_end + summary + offsets + footer + _U32.pack(checksum) + MAGIC


def summary_of(data: Any) -> tuple[int, bytes] | None:
    """Where the summary of a finished file begins, and its records; None if the file does not end as it should.

    ``data``: bytes or an mmap. The checksum has been verified.
    """
    tail = HEAD.size + _FOOTER.size + len(MAGIC)
    size = len(data)
    if size < len(MAGIC) + tail or data[size - len(MAGIC) : size] != MAGIC:
        return None
    at = size - tail
    op, length = HEAD.unpack_from(data, at)
    if op != Op.FOOTER or length != _FOOTER.size:
        return None
    start, offsets, checksum = _FOOTER.unpack_from(data, at + HEAD.size)
    start = start or at  # 0: there is none
    if at - start > _LARGEST_SUMMARY or not len(MAGIC) <= start <= at or not (start <= offsets <= at or offsets == 0):
        return None
    if checksum and zlib.crc32(data[start : at + HEAD.size + _PAIR.size]) != checksum:
        return None
    return start, data[start : offsets or at]


def chunk(records: bytes, start_ns: int, end_ns: int, packer: Packer) -> bytes:
    packed = packer.pack(records)
    head = CHUNK.pack(start_ns, end_ns, len(records), zlib.crc32(records))
    return record(Op.CHUNK, head + _text(packer.name) + _U64.pack(len(packed)) + packed)


def unpack_chunk(body: bytes) -> bytes:
    """The records of a chunk. Raises DamageError if its checksum says that they are not what was written."""
    with _Reading(body) as reading:
        _, _, size, checksum = CHUNK.unpack(reading.take(CHUNK.size))
        name = reading.text()
        packed = reading.take(reading.u64())
        if reading.rest():
            raise DamageError("a chunk is longer than it says")
    if size > LARGEST_CHUNK:
        raise DamageError(f"a chunk of {size} bytes")
    records = packed if not name else _unpack(name, packed, size)
    if len(records) != size or (checksum and zlib.crc32(records) != checksum):
        raise DamageError("a chunk's checksum is wrong")
    return records


def chunk_compression(body: bytes) -> tuple[str, int]:
    """How a chunk is packed, and its packed size. Raises DamageError."""
    with _Reading(body) as reading:
        reading.take(CHUNK.size)
        return reading.text(), reading.u64()


def records(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Opcode, begin and end of the body of each record in ``data``. Raises DamageError at one that is cut off."""
    at, size = 0, len(data)
    while at < size:
        if at + HEAD.size > size:
            raise DamageError("a record is cut off")
        op, length = HEAD.unpack_from(data, at)
        at += HEAD.size
        if at + length > size or (op == Op.MESSAGE and length < MESSAGE.size):
            raise DamageError("a record is cut off")
        yield op, at, at + length
        at += length


class Packer:
    """Compresses chunks by Zstandard; stores them as they are where the package is not installed, or ``level`` is 0."""

    def __init__(self, level: int = 3) -> None:
        zstandard = zstandard_or_none() if level else None
        self._compress = None if zstandard is None else zstandard.ZstdCompressor(level=level).compress
        self.name = "" if zstandard is None else "zstd"

    def pack(self, data: bytes) -> bytes:
        return data if self._compress is None else self._compress(data)


@cache
def zstandard_or_none() -> Any:
    """The package of the extra ``record``."""
    try:
        return importlib.import_module("zstandard")
    except ImportError:
        return None


def _unpack(name: str, packed: bytes, size: int) -> bytes:
    """At most one byte more than ``size``."""
    unpackers = {"zstd": _unpack_zstd, "lz4": _unpack_lz4}
    if name not in unpackers:
        raise DamageError(f"a chunk is compressed by {name[:_NAME_LENGTH]!r}, which is none of MCAP's")
    try:
        return unpackers[name](packed, size)
    except ImportError:
        raise UnreadableError(f'it is compressed by {name}: pip install "pebble-robot[record]"') from None


def _unpack_zstd(packed: bytes, size: int) -> bytes:
    zstandard = importlib.import_module("zstandard")
    try:
        with zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True) as reader:
            unpacked: bytes = reader.read(size + 1)
    except zstandard.ZstdError as error:
        raise DamageError(f"a chunk cannot be unpacked: {error}") from None
    return unpacked


def _unpack_lz4(packed: bytes, size: int) -> bytes:
    lz4 = importlib.import_module("lz4.frame")
    unpacked = b""
    try:
        while packed and len(unpacked) <= size:
            frame = lz4.LZ4FrameDecompressor()
            unpacked += frame.decompress(packed, max_length=size + 1 - len(unpacked))
            packed = frame.unused_data or b""
    except RuntimeError as error:
        raise DamageError(f"a chunk cannot be unpacked: {error}") from None
    return unpacked


class _Reading:
    """Reads a body from its begin; what it does not hold is damage."""

    def __init__(self, body: bytes) -> None:
        self._body, self._at = body, 0

    def __enter__(self) -> _Reading:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _traceback: object) -> None:
        if isinstance(error, struct.error | UnicodeDecodeError):
            raise DamageError("a record is damaged") from None

    def take(self, size: int) -> bytes:
        begin, self._at = self._at, self._at + size
        if self._at > len(self._body):
            raise DamageError("a record is cut off")
        return self._body[begin : self._at]

    def u16(self) -> int:
        return int(_U16.unpack(self.take(2))[0])

    def u32(self) -> int:
        return int(_U32.unpack(self.take(4))[0])

    def u64(self) -> int:
        return int(_U64.unpack(self.take(8))[0])

    def text(self) -> str:
        return self.take(self.u32()).decode()

    def rest(self) -> bytes:
        return self._body[self._at :]

    def texts(self) -> dict[str, str]:
        reading = _Reading(self.take(self.u32()))
        found = {}
        while reading._at < len(reading._body):
            key = reading.text()
            found[key] = reading.text()
        return found


def _name(text: str) -> str:
    return text if len(text) == _NAME_LENGTH and all(digit in _HEXADECIMAL for digit in text) else ""


def _text(text: str) -> bytes:
    raw = text.encode()
    return _U32.pack(len(raw)) + raw


def _texts(items: Mapping[str, str]) -> bytes:
    body = b"".join(_text(key) + _text(value) for key, value in items.items())
    return _U32.pack(len(body)) + body
