"""Recordings as other programs write them: by the package ``mcap``, and record by record where it cannot."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable
from typing import Any, Final

from mcap.writer import CompressionType, IndexType, Writer

from pebble.extensions.recordings.files.records import MAGIC
from tests.ext.recordings.messages import START_NS, STEP_NS

GOOB, FRED = "pebble/robots/goob/outgoing/online", "pebble/robots/fred/outgoing/online"
COUNT: Final = 40
SCHEMA: Final = ("Online", "jsonschema", b'{"type": "object"}')
ORDERS: Final[dict[str, list[int]]] = {
    "forward": list(range(COUNT)),
    "interleaved": [*range(0, COUNT, 2), *range(1, COUNT, 2)],
}
NONE, LZ4, ZSTD = CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD


def payload(number: int) -> bytes:
    return b'{"t": %d, "rest": "%s"}' % (number, b"x" * 20)


def by_package(
    *, order: str = "forward", schema: bool = True, beside: bool = False,
    sequence: Callable[[int], int] = lambda number: number, library: str = "other", start_ns: int = START_NS,
    **options: Any,
) -> bytes:  # fmt: skip
    """The message ``number`` is of goob, or each fourth of fred; its time grows with its number."""
    out = io.BytesIO()
    writer = Writer(out, **{"compression": NONE, "chunk_size": 400, **options})
    writer.start(library=library)
    if beside:
        writer.add_metadata("about", {"place": "hall"})
        writer.add_metadata("about", {"place": "yard"})
        writer.add_attachment(1, 2, "plan.txt", "text/plain", b"walls")
    number = writer.register_schema(*SCHEMA) if schema else 0
    goob, fred = (writer.register_channel(topic, "json", number) for topic in (GOOB, FRED))
    for one in ORDERS[order]:
        writer.add_message(fred if one % 4 == 3 else goob, start_ns + one * STEP_NS, payload(one), 0, sequence(one))
    writer.finish()
    return out.getvalue()


# -- record by record


def record(op: int, body: bytes) -> bytes:
    return struct.pack("<BQ", op, len(body)) + body


def text(value: str | bytes) -> bytes:
    raw = value.encode() if isinstance(value, str) else value
    return struct.pack("<I", len(raw)) + raw


def channel(number: int, topic: str, encoding: str = "json") -> bytes:
    return record(4, struct.pack("<HH", number, 0) + text(topic) + text(encoding) + text(b""))


def message(number: int) -> bytes:
    of = 2 if number % 4 == 3 else 1
    at = START_NS + number * STEP_NS
    return record(5, struct.pack("<HIQQ", of, number, at, at) + payload(number))


def chunk(*records: bytes) -> bytes:
    raw = b"".join(records)
    head = struct.pack("<QQQI", START_NS, START_NS + COUNT * STEP_NS, len(raw), zlib.crc32(raw))
    return record(6, head + text("") + struct.pack("<Q", len(raw)) + raw)


def whole(*data: bytes, library: str = "pebble 1.0") -> bytes:
    """A file without a summary."""
    return b"".join(
        [MAGIC, record(1, text("") + text(library)), *data, record(15, bytes(4)), record(2, bytes(20)), MAGIC]
    )


MESSAGES = [message(number) for number in range(COUNT)]

#: All hold the same messages.
VALID: Final[dict[str, bytes]] = {
    "zstd": by_package(compression=ZSTD),
    "lz4": by_package(compression=LZ4),
    "chunks overlap": by_package(order="interleaved"),
    "one chunk in another order": by_package(order="interleaved", chunk_size=1 << 20),
    "a library like ours": by_package(library="pebble rosbag2-recorder", sequence=lambda number: 1000 - number),
    "metadata and attachments": by_package(beside=True),
}
#: Files that are not read at all: what another program wrote needs an index of all its messages.
REFUSED: Final[dict[str, bytes]] = {
    "no chunks": by_package(use_chunking=False),
    "no statistics": by_package(use_statistics=False),
    "no index of chunks": by_package(index_types=IndexType.ALL & ~IndexType.CHUNK),
    "no index of messages": by_package(index_types=IndexType.ALL & ~IndexType.MESSAGE),
    "summary without channels": by_package(repeat_channels=False, repeat_schemas=False),
    "cut off": by_package()[:-30],
}
LATEST: Final = (1 << 64) - 1
#: Messages that differ in their times or encodings.
OTHERS: Final[dict[str, bytes]] = {
    "no schema": by_package(schema=False),
    "the latest time": by_package(start_ns=LATEST - COUNT * STEP_NS),
    "two channels of one topic": whole(channel(1, GOOB), channel(2, GOOB), chunk(*MESSAGES)),
}


def flipped(data: bytes, at: int, bit: int = 0) -> bytes:
    raw = bytearray(data)
    raw[at] ^= 1 << bit
    return bytes(raw)


def _of(op: int, data: bytes) -> int:
    """Where the first record of this kind begins."""
    at = len(MAGIC)
    while data[at] != op:
        at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
    return at


_FILE = by_package(compression=ZSTD, library="pebble 1.0")
#: Files that cannot be read completely, and a part of what is said of them.
DAMAGED: Final[dict[str, tuple[bytes, str]]] = {
    "a chunk": (flipped(_FILE, _of(6, _FILE) + 70), "damaged part"),
    "the kind of a chunk": (flipped(_FILE, _of(6, _FILE), 7), "messages missing"),
    "the begin": (flipped(_FILE, 3), "does not begin as MCAP"),
    "the summary": (flipped(_FILE, _of(11, _FILE) + 20), "its end is missing or damaged"),
    "cut off in a chunk": (_FILE[: _of(6, _FILE) + 90], "at its end cannot be read"),
    "a channel that is none": (whole(channel(1, GOOB), chunk(*MESSAGES)), "without a topic"),
    "empty": (b"", "is empty"),
}  # fmt: skip
