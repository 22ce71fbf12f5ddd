"""The records of MCAP files (https://mcap.dev/spec), parsed by the package ``mcap``; its errors count as damage."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from enum import IntEnum
from io import BytesIO
from typing import TYPE_CHECKING, Final

from pebble.extensions.recordings.files.recorded import DamageError

if TYPE_CHECKING:
    from mcap.records import McapRecord
    from mcap.summary import Summary

MAGIC: Final = b"\x89MCAP0\r\n"
LARGEST_CHUNK: Final = 64 << 20  # unpacked: ours are about 1 MB, and hold one message more than that
LARGEST_RECORD: Final = LARGEST_CHUNK + (1 << 16)


class Op(IntEnum):
    """Kinds of records before a summary."""

    HEADER = 0x01
    SCHEMA = 0x03
    CHANNEL = 0x04
    MESSAGE = 0x05
    CHUNK = 0x06
    MESSAGE_INDEX = 0x07
    METADATA = 0x0C
    DATA_END = 0x0F


HEAD: Final = struct.Struct("<BQ")  # opcode, length of what follows
MESSAGE: Final = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
CHUNK: Final = struct.Struct("<QQQII")  # first and last log time, unpacked size, checksum, length of a name
INDEX: Final = struct.Struct("<BQHI")  # opcode, length, channel, length of the entries
#: The begin of a chunk of ours: opcode; a length below 4 GB; "zstd", or uncompressed.
LOOKS_LIKE_CHUNK: Final = re.compile(rb"\x06.{4}\x00{4}.{28}(?:\x04\x00{3}zstd|\x00{4}).{4}\x00{4}", re.DOTALL)


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


def unpack_chunk(data: bytes) -> bytes:
    """Return the records that the chunk ``data`` contains. Raises DamageError if its checksum is wrong."""
    from mcap.records import Chunk
    from mcap.stream_reader import get_chunk_data_stream

    chunk = record_of(data)
    if not isinstance(chunk, Chunk) or chunk.uncompressed_size > LARGEST_CHUNK:
        raise DamageError("a chunk is damaged")
    with _damage():
        stream, size = get_chunk_data_stream(chunk, validate_crc=True)
        return stream.read(size)


def record_of(data: bytes) -> McapRecord:
    """Return the parsed record. Raises DamageError, also for lengths that do not fit (a Chunk has a checksum)."""
    from mcap.data_stream import RecordBuilder
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader

    builder = RecordBuilder()
    with _damage():
        record = next(StreamReader(BytesIO(data), skip_magic=True, emit_chunks=True).records)
        if isinstance(record, Chunk):
            return record
        record.write(builder)
    if builder.end() != data:
        raise DamageError("a record's lengths are damaged")
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
    except Exception as error:  # noqa: BLE001  the package raises its own, struct's, zstandard's, KeyError, StopIteration …
        raise DamageError(f"a record is damaged: {error or type(error).__name__}") from None
