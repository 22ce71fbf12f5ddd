"""The records of MCAP files (https://mcap.dev/spec), parsed by the package ``mcap``; its errors count as damage."""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from enum import IntEnum
from io import BytesIO
from typing import TYPE_CHECKING, Final

from pebble.errors import PebbleError
from pebble.extensions.recordings.files.recorded import Channel, DamageError

if TYPE_CHECKING:
    from mcap.records import McapRecord
    from mcap.summary import Summary

MAGIC: Final = b"\x89MCAP0\r\n"
LARGEST_CHUNK: Final = 64 << 20  # unpacked: ours are about 1 MB, and hold one message more than that
LARGEST_RECORD: Final = LARGEST_CHUNK + (1 << 16)


class Op(IntEnum):
    """Kinds of records; those from PADDING on are private to the program that wrote them."""

    HEADER = 0x01
    FOOTER = 0x02
    SCHEMA = 0x03
    CHANNEL = 0x04
    MESSAGE = 0x05
    CHUNK = 0x06
    MESSAGE_INDEX = 0x07
    ATTACHMENT = 0x09
    METADATA = 0x0C
    DATA_END = 0x0F
    PADDING = 0x80  # covers damaged bytes in files of the last version


HEAD: Final = struct.Struct("<BQ")  # opcode, length of what follows
MESSAGE: Final = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
CHUNK: Final = struct.Struct("<QQQII")  # first and last log time, unpacked size, checksum, length of a name
INDEX: Final = struct.Struct("<BQHI")  # opcode, length, channel, length of the entries
FOOTER: Final = struct.Struct("<BQQQI")
#: The begin of a chunk: opcode; lengths below 4 GB; one of MCAP's compressions, and how its data begin.
LOOKS_LIKE_CHUNK: Final = re.compile(
    rb"\x06.{4}\x00{4}.{16}.{4}\x00{4}.{4}"
    rb"(?:\x04\x00{3}zstd.{4}\x00{4}\x28\xb5\x2f\xfd|\x03\x00{3}lz4.{4}\x00{4}\x04\x22\x4d\x18|\x00{4}.{4}\x00{4})",
    re.DOTALL,
)


def records(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, begin and end of each record's body in ``data``. Raises DamageError if the last is cut off."""
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


def unpack_chunk(body: bytes) -> bytes:
    """Return the records of a chunk. Raises DamageError if its checksum is wrong."""
    with _damage():
        _, _, size, checksum, name_length = CHUNK.unpack_from(body)
        at = CHUNK.size + name_length
        name, packed = body[CHUNK.size : at].decode(), body[at + 8 :]
    if size > LARGEST_CHUNK:
        raise DamageError(f"a chunk of {size} bytes")
    unpacked = _unpack(name, packed, size)
    if len(unpacked) != size or (checksum and zlib.crc32(unpacked) != checksum):
        raise DamageError("a chunk's checksum is wrong")
    return unpacked


def with_own_topic(channel: Channel, payload: bytes) -> tuple[Channel, bytes]:
    """Return channel and payload of a payload that begins with topic and metadata. Raises DamageError."""
    from mcap.data_stream import ReadDataStream
    from mcap.records import Metadata

    with _damage():
        stream = ReadDataStream(BytesIO(payload))
        metadata = Metadata.read(stream)
    return Channel(channel.id, metadata.name, channel.encoding, metadata.metadata), payload[stream.count :]


def record_of(data: bytes) -> McapRecord:
    """Return the parsed record. Raises DamageError, also for a channel whose lengths do not fit exactly."""
    from mcap.data_stream import RecordBuilder
    from mcap.records import Channel as ChannelRecord
    from mcap.stream_reader import StreamReader

    builder = RecordBuilder()
    with _damage():
        record = next(StreamReader(BytesIO(data), skip_magic=True).records)
        if isinstance(record, ChannelRecord):
            record.write(builder)
    if isinstance(record, ChannelRecord) and builder.end() != data:
        raise DamageError("the name of a channel is damaged")
    return record


def summary_of(tail: bytes) -> Summary | None:
    """Return the summary of a file; None if it has none. ``tail`` is the file's end from its summary on.

    Raises DamageError.
    """
    from mcap.reader import NonSeekingReader

    with _damage():
        return NonSeekingReader(BytesIO(MAGIC + tail)).get_summary()


@contextmanager
def _damage() -> Iterator[None]:
    """Raise DamageError in place of the errors of parsing damaged bytes."""
    try:
        yield
    except PebbleError:
        raise
    except Exception as error:  # noqa: BLE001  the package raises its own, struct's, zstandard's, KeyError, StopIteration …
        raise DamageError(f"a record is damaged: {error or type(error).__name__}") from None


def _unpack(name: str, packed: bytes, size: int) -> bytes:
    """Decompress at most ``size`` + 1 bytes, since the size in the data may be wrong."""
    if not name:
        return packed
    with _damage():
        if name == "zstd":
            import zstandard

            with zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True) as reader:
                return reader.read(size + 1)
        if name == "lz4":
            import lz4.frame

            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size + 1))
    raise DamageError(f"a chunk is compressed by {name[:16]!r}, which is none of MCAP's")
