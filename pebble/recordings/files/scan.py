"""Finds the records of a file in any state: cut off, with damaged bytes or zeros anywhere. Pure."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

from pebble.recordings.files import mcap
from pebble.recordings.files.mcap import HEAD, MAGIC, MESSAGE, DamageError, Metadata, Op

#: The head of a chunk: opcode; three lengths below 4 GB; a compression of MCAP's, or none.
_CHUNK_HEAD: Final = re.compile(
    rb"\x06.{4}\x00{4}.{16}.{4}\x00{4}.{4}(?:\x04\x00{3}zstd|\x03\x00{3}lz4|\x00{4})", re.DOTALL
)
_LARGEST_TEXTS: Final = 1 << 16  # header and metadata have no checksum
_LARGEST_FOUND: Final = 20 << 20  # behind damage: hostile payloads hold many heads of chunks
_FIRST_RECORD: Final = 256  # bytes at the begin of a chunk that hold the name of its file
_ZSTANDARD: Final = b"\x28\xb5\x2f\xfd"  # how its frames begin
_LONGEST_NAME: Final = 16  # of a compression
_U32_SIZE: Final = 4
_LARGEST_RECORD: Final = mcap.LARGEST_CHUNK + (1 << 16)
_PLAIN: Final = frozenset({Op.PADDING, Op.ATTACHMENT})
_AFTER_A_RECORD: Final = _PLAIN | {Op.METADATA, Op.CHUNK, Op.DATA_END}


class Block(NamedTuple):
    """A record in the data of a file, with the indexes that belong to it."""

    op: Op
    at: int
    record_end: int
    end: int  # after its indexes; the same as record_end if they are damaged, or if it has none
    body: bytes  # of a chunk: its records


@dataclass(slots=True)
class Damage:
    """What is wrong with a file."""

    spans: list[tuple[int, int]] = field(default_factory=list)  # bytes that are no records
    missing: int = 0  # messages, by their numbers; those at a torn end are not known
    orphans: int = 0  # messages whose channel is not named anywhere
    torn: int = 0  # bytes at the end that are no record
    finished: bool = False  # the file ends with a summary

    @property
    def found(self) -> bool:
        return bool(self.spans or self.missing or self.orphans or self.torn)


def blocks(data: Any, damage: Damage, at: int = 0) -> Iterator[Block]:
    """The records in the data of a file, from ``at`` on, in its order; what lies between them is noted in ``damage``.

    ``data``: bytes or an mmap. A chunk is yielded only if its checksum is right.
    """
    begin, file = _after_header(data)
    at = at or begin
    due, last_ns = 0, 0
    while at < len(data):
        block = _block(data, at)
        if block is not None and block.op is Op.CHUNK:
            reached = _reaches(block.body, due, last_ns)
            block = block if reached is not None else None
        if block is None or block.op is Op.DATA_END:  # a flipped bit makes one of an index
            again = _next_chunk(data, at, file, due, last_ns)
            if again is not None:
                damage.spans.append((at, again.at))
            elif block is None:
                damage.torn = len(data) - at
                return
            else:
                damage.finished = mcap.summary_of(data) is not None
                return
            block = again
        if block.op is Op.CHUNK:
            file = file or mcap.file_of_chunk(block.body)
            due, last_ns = _reaches(block.body, due, last_ns) or (due, last_ns)
        yield block
        at = block.end


def _after_header(data: Any) -> tuple[int, str]:
    """Where the first record begins, and the name of the file; 0 and "" if the header is damaged."""
    at = len(MAGIC)
    if len(data) < at + HEAD.size or data[:at] != MAGIC:
        return 0, ""
    op, length = HEAD.unpack_from(data, at)
    begin, at = at + HEAD.size, at + HEAD.size + length
    if op != Op.HEADER or length > _LARGEST_TEXTS or at > len(data):
        return 0, ""
    try:
        return at, mcap.file_of_header(data[begin:at])
    except DamageError:
        return 0, ""


def _block(data: Any, at: int, most: int = _LARGEST_RECORD) -> Block | None:
    """The record at ``at``, if it is one."""
    size = len(data)
    if at + HEAD.size > size:
        return None
    op, length = HEAD.unpack_from(data, at)
    begin, end = at + HEAD.size, at + HEAD.size + length
    if end > size or length > most:
        return None
    if op == Op.CHUNK:
        if not _fits(data, begin, length):
            return None
        try:
            records = mcap.unpack_chunk(data[begin:end])
        except DamageError:
            return None
        return Block(Op.CHUNK, at, end, _after_indexes(data, end), records)
    if op == Op.DATA_END and length == _U32_SIZE:
        return Block(Op.DATA_END, at, end, end, b"")
    if op == Op.METADATA:
        return Block(Op.METADATA, at, end, end, data[begin:end]) if _is_metadata(data, begin, end) else None
    if op in _PLAIN and (end == size or data[end] in _AFTER_A_RECORD):
        return Block(Op(op), at, end, end, b"" if op == Op.PADDING else data[begin:end])
    return None


def _fits(data: Any, begin: int, length: int) -> bool:
    """Whether the lengths in the head of a chunk agree, before many bytes are read."""
    at = begin + mcap.CHUNK.size
    name = int.from_bytes(data[at : at + 4], "little")
    packed = int.from_bytes(data[at + 4 + name : at + 12 + name], "little") if name < _LONGEST_NAME else -1
    return length == mcap.CHUNK.size + 12 + name + packed


def _is_metadata(data: Any, begin: int, end: int) -> bool:
    """It has no checksum: it must be exactly what its contents say."""
    if end - begin > _LARGEST_TEXTS:
        return False
    try:
        return bool(Metadata.unpack(data[begin:end]).pack()[HEAD.size :] == data[begin:end])
    except DamageError:
        return False


def _after_indexes(data: Any, at: int) -> int:
    """Where the indexes of a chunk end that ends at ``at``; ``at`` if one of them is damaged."""
    begin, size = at, len(data)
    while at + HEAD.size + 6 <= size and data[at] == Op.MESSAGE_INDEX:
        _, length = HEAD.unpack_from(data, at)
        entries = int.from_bytes(data[at + HEAD.size + 2 : at + HEAD.size + 6], "little")
        if length != 6 + entries or entries % 16:
            return begin
        at += HEAD.size + length
    return at if at == size or (at < size and data[at] in _AFTER_A_RECORD) else begin


def _next_chunk(data: Any, at: int, file: str, due: int, last_ns: int) -> Block | None:
    """The first chunk behind ``at`` that belongs to this file: a payload may be another recording."""
    at = max(at, len(MAGIC))
    while (found := _CHUNK_HEAD.search(data, at)) is not None:
        at = found.start() + 1
        if not _may_be_chunk(data, found, file):
            continue
        block = _block(data, found.start(), _LARGEST_FOUND)
        if block is not None and _belongs(block.body, file, due, last_ns):
            return block
    return None


def _may_be_chunk(data: Any, found: re.Match[bytes], file: str) -> bool:
    """A quick look before many bytes are read."""
    records = found.end() + 8
    if found.group().endswith(b"zstd"):
        return bool(data[records : records + len(_ZSTANDARD)] == _ZSTANDARD)
    return not file or file.encode() in data[records : records + _FIRST_RECORD]


def _belongs(records: bytes, file: str, due: int, last_ns: int) -> bool:
    """Whether a chunk that was found behind damage is of the file ``file`` (""; not known), and was not read before."""
    if file and mcap.file_of_chunk(records) != file:
        return False
    if _reaches(records, due, last_ns) is None:
        return False
    first = next(_numbers(records), None)
    return first is not None and first[0] >= due and first[1] >= last_ns


def _reaches(records: bytes, due: int, last_ns: int) -> tuple[int, int] | None:
    """The number that the next message has, and the time of the last one; None if the records are none."""
    try:
        for sequence, log_ns in _numbers(records):
            due, last_ns = max(due, sequence + 1), max(last_ns, log_ns)
    except DamageError:
        return None
    return due, last_ns


def _numbers(records: bytes) -> Iterator[tuple[int, int]]:
    for op, begin, _ in mcap.records(records):
        if op == Op.MESSAGE:
            _, sequence, log_ns, _ = MESSAGE.unpack_from(records, begin)
            yield sequence, log_ns
