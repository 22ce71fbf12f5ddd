"""Finds the records of a file in any state: cut off, with damaged bytes or zeros anywhere. Pure."""

import re
import zlib
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
_CHUNK_HEAD_SIZE: Final = HEAD.size + mcap.CHUNK.size + 16  # with the name of a compression
_NOT_ZERO: Final = re.compile(rb"[^\x00]")
_LONGEST_NAME: Final = 16  # of a compression
_U32_SIZE: Final = 4
_LOOSE: Final = 1 << 20  # bytes of records outside of chunks that are read at once
_IN_CHUNKS: Final = frozenset({Op.SCHEMA, Op.CHANNEL, Op.MESSAGE})
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
    known: int = 0  # of them, those that the file itself says are missing
    orphans: int = 0  # messages whose channel is not named anywhere
    torn: int = 0  # bytes at the end that are no record
    finished: bool = False  # the file ends with a summary
    unended: bool = False  # it was read to where it stops, and has no end
    covered: int = 0  # bytes that finishing the file has covered
    private: int = 0  # records that are only known to the program that wrote them
    why: str = ""  # the first reason

    @property
    def found(self) -> bool:
        return bool(self.spans or self.missing or self.orphans or self.torn)

    @property
    def unread(self) -> bool:
        """Whether a file holds, or may hold, anything that was not read: it must not be replaced by what was."""
        missing = self.missing > self.known
        return bool(missing or self.spans or self.orphans or self.torn or self.covered or self.private) or self.unended

    def note(self, why: object) -> None:
        self.why = self.why or str(why)

    def report(self, *, active: bool = False) -> str:
        """What could not be read, in words; "" if all was. One that is ``active`` needs no end."""
        spans, size = len(self.spans), sum(end - begin for begin, end in self.spans)
        found = [
            (spans, f"{spans:,} damaged parts ({size:,} bytes)"),
            (self.missing > self.known, f"{self.missing - self.known:,} messages missing"),
            (self.orphans, f"{self.orphans:,} messages without a topic"),
            (self.torn and not active, f"{self.torn:,} bytes at its end cannot be read"),
            (self.unended and not active, "its end is missing or damaged, or it is being written"),
        ]
        text = ", ".join(words for number, words in found if number)
        return f"{text} ({self.why})" if text and self.why else text


def is_of_others(data: Any) -> bool:
    """Whether another program than a recorder wrote the file: its messages have any order and any numbers."""
    return _after_header(data)[1] is None


def begins_as_ours(data: Any) -> bool:
    """Whether the header is that of a recorder, and not damaged."""
    begin, file = _after_header(data)
    return bool(begin) and file is not None


def blocks(data: Any, damage: Damage, at: int = 0) -> Iterator[Block]:
    """The records in the data of a file, from ``at`` on, in its order; what lies between them is noted in ``damage``.

    ``data``: bytes or an mmap. A chunk is yielded only if its checksum is right. Records of messages and channels
    outside of chunks, which other programs write, are yielded as chunks. Raises UnreadableError.
    """
    begin, file = _after_header(data)
    at = at or begin
    if file is None:
        yield from _blocks_of_others(data, damage, at)
        return
    if not begin and data[: len(MAGIC)] != MAGIC:
        damage.note("it does not begin as MCAP does" if len(data) else "it is empty")
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
                damage.torn, damage.unended = len(data) - at, True
                return
            else:
                damage.finished = mcap.summary_of(data) is not None
                damage.unended = not damage.finished
                return
            block = again
        if block.op is Op.CHUNK:
            file = file or mcap.file_of_chunk(block.body)
            due, last_ns = _reaches(block.body, due, last_ns) or (due, last_ns)
        elif block.op is Op.PADDING:
            damage.covered += block.end - block.at
        yield block
        at = block.end
    damage.unended = True


def _blocks_of_others(data: Any, damage: Damage, at: int) -> Iterator[Block]:
    """A length that cannot be true ends the file: what looks like a chunk behind it may be a part of a payload."""
    loose = at  # where records outside of chunks begin that were not yielded
    while True:
        found = _framed(data, at)
        if at > loose and (found is None or found[0] not in _IN_CHUNKS or at - loose >= _LOOSE):
            yield Block(Op.CHUNK, loose, at, at, data[loose:at])
            loose = at
        if found is None:
            damage.torn, damage.unended = len(data) - at, True
            return
        op, begin, end = found
        if op in (Op.DATA_END, Op.FOOTER):
            damage.finished = mcap.summary_of(data) is not None
            damage.unended = not damage.finished
            checksum = int.from_bytes(data[begin:end], "little") if op == Op.DATA_END else 0
            if checksum and _checksum(data, 0, at) != checksum:
                damage.spans.append((0, at))
                damage.note("the checksum of all data is wrong")
            return
        if op not in _IN_CHUNKS:
            block = _block_of_others(data, op, at, begin, end, damage)
            if block is not None:
                yield block
            loose = end
        at = end


def is_cut_off(data: Any, at: int) -> bool:
    """Whether from ``at`` on there are indexes, zeros, or the begin of one record that the end of the file cuts off."""
    while (end := _after_index(data, at)) and end <= len(data):
        at = end
    rest = len(data) - at
    if rest < HEAD.size or _NOT_ZERO.search(data, at) is None:
        return True
    op, length = HEAD.unpack_from(data, at)
    if op == Op.CHUNK:
        return length > rest - HEAD.size and (rest < _CHUNK_HEAD_SIZE or _fits(data, at + HEAD.size, length))
    return bool(end) or (op in (Op.METADATA, Op.DATA_END) and length > rest - HEAD.size)


def _after_index(data: Any, at: int) -> int:
    """Where the index of a chunk ends that begins at ``at``; 0 if none does."""
    if at + HEAD.size + 6 > len(data) or data[at] != Op.MESSAGE_INDEX:
        return 0
    _, length = HEAD.unpack_from(data, at)
    entries = int.from_bytes(data[at + HEAD.size + 2 : at + HEAD.size + 6], "little")
    return 0 if length != 6 + entries or entries % 16 else at + HEAD.size + length


def _framed(data: Any, at: int) -> tuple[int, int, int] | None:
    """The opcode of the record at ``at``, and where its body begins and ends; None if it is none."""
    if at + HEAD.size > len(data):
        return None
    op, length = HEAD.unpack_from(data, at)
    begin, end = at + HEAD.size, at + HEAD.size + length
    least = {Op.MESSAGE: MESSAGE.size, Op.DATA_END: _U32_SIZE}.get(op, 0)
    if op == 0 or end > len(data) or length < least or (op == Op.CHUNK and not _fits(data, begin, length)):
        return None
    return op, begin, end


def _block_of_others(data: Any, op: int, at: int, begin: int, end: int, damage: Damage) -> Block | None:
    """None for a record that holds no messages, or is damaged."""
    try:
        if op == Op.CHUNK:
            records = mcap.unpack_chunk(data[begin:end])
            for _ in mcap.records(records):
                pass
            return Block(Op.CHUNK, at, end, end, records)
        if op == Op.METADATA:
            Metadata.unpack(data[begin:end])
            return Block(Op.METADATA, at, end, end, data[begin:end])
        if op == Op.ATTACHMENT:
            if not _is_attachment(data, begin, end):
                raise DamageError("the checksum of an attachment is wrong")
            return Block(Op.ATTACHMENT, at, end, end, b"")
    except DamageError as error:
        damage.spans.append((at, end))
        damage.note(error)
        return None
    damage.private += op != Op.MESSAGE_INDEX
    return None


def _is_attachment(data: Any, begin: int, end: int) -> bool:
    checksum = int.from_bytes(data[end - _U32_SIZE : end], "little") if end - begin > _U32_SIZE else -1
    return checksum == 0 or _checksum(data, begin, end - _U32_SIZE) == checksum


def _checksum(data: Any, begin: int, end: int) -> int:
    with memoryview(data) as view, view[begin:end] as part:
        return zlib.crc32(part)


def block_at(data: Any, at: int, end: int) -> Block:
    """One of :func:`blocks` again, which are chunks."""
    is_chunk = data[at] == Op.CHUNK
    return Block(Op.CHUNK, at, end, end, mcap.unpack_chunk(data[at + HEAD.size : end]) if is_chunk else data[at:end])


def _after_header(data: Any) -> tuple[int, str | None]:
    """Where the first record begins, and the name of the file, None for one of another program.

    0 and "" if the header is damaged.
    """
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
        return Block(Op(op), at, end, end, b"") if op == Op.PADDING or _is_attachment(data, begin, end) else None
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
    while at < size and data[at] == Op.MESSAGE_INDEX and (after := _after_index(data, at)):
        at = after
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
