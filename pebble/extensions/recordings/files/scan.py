"""A scan for the records of a file without a summary, from its beginning to its end, also after damage."""

import struct
from collections.abc import Callable, Iterator
from typing import Final, NamedTuple

from pebble.extensions.recordings.files.recorded import Damage, DamageError
from pebble.extensions.recordings.files.records import (
    CHUNK,
    HEAD,
    LARGEST_RECORD,
    LOOKS_LIKE_CHUNK,
    MAGIC,
    Op,
    record_of,
    records,
    unpack_chunk,
)

INDEX_ENTRY: Final = 16  # bytes
_INDEX: Final = struct.Struct("<HI")  # channel, length of the entries
_KINDS: Final = frozenset(Op) - {Op.MESSAGE}  # of records outside of chunks
_LONGEST_NAME: Final = 16  # of a compression
#: Bytes behind damage that are searched at once, and as many more as the head of a chunk may have.
_SEARCHED, _OVERLAP = 1 << 20, 64

#: Takes a position and a length; there may be less.
Read = Callable[[int, int], bytes]


class Found(NamedTuple):
    """A record with its place; of a chunk also its channels (none if an index is damaged) and number of messages."""

    op: int
    at: int
    end: int
    channels: frozenset[int] = frozenset()
    messages: int = 0


class Scan:
    """A scan that continues where it ended, when the file has grown. Records that we never write count as damage."""

    def __init__(self, read: Read, damage: Damage) -> None:
        self._read, self._damage = read, damage
        self._at = len(MAGIC)  # where the last record that was found ends
        self._searched = 0  # after damage, no chunk begins before this position
        self._size, self._ended = 0, False

    @property
    def is_cut_off(self) -> bool:
        """True if only zeros, or the beginning of a record, follow the last record, as after a kill."""
        tail = self._read(self._at, min(self._damage.torn, LARGEST_RECORD))
        if len(tail) < HEAD.size or not any(tail):
            return len(tail) >= self._damage.torn
        op, length = HEAD.unpack_from(tail)
        return op in _KINDS and length < 1 << 32 and self._at + HEAD.size + length > self._size

    def records(self, size: int) -> Iterator[Found]:
        """Yield the records of a file of ``size`` bytes that were not yielded before."""
        self._size = size
        while self._at < size and not self._ended:
            record = self._record_at(self._at)
            if record is None:
                next_chunk = self._next_chunk(max(self._at + 1, self._searched))
                if next_chunk is None:  # a chunk may begin at the end, and be complete when the file has grown
                    self._searched = max(self._searched, size - _OVERLAP)
                    break
                self._damage.add(self._at, f"{next_chunk - self._at:,} bytes are no record")
                self._at = next_chunk
                continue
            self._at, self._ended = record.end, record.op == Op.DATA_END
            yield self._with_indexes(record) if record.op == Op.CHUNK else record
        self._damage.torn = 0 if self._ended else max(0, size - self._at)

    def _with_indexes(self, chunk: Found) -> Found:
        """Read the indexes behind a chunk; return it with its number of messages, and its channels if all are whole.

        Without channels these are looked for in the chunk.
        """
        counts: dict[int, int] = {}
        while (record := self._record_at(self._at)) is not None and record.op == Op.MESSAGE_INDEX:
            channel, length = _INDEX.unpack(self._read(self._at + HEAD.size, _INDEX.size))
            counts[channel], self._at = length // INDEX_ENTRY, record.end
        are_complete = record is not None or self._at >= self._size  # something else follows, or the file ends here
        return chunk._replace(channels=frozenset(counts if are_complete else ()), messages=sum(counts.values()))

    def _record_at(self, at: int) -> Found | None:
        """Return the record at ``at``; None if there is no complete record."""
        head = self._read(at, HEAD.size)
        op, length = HEAD.unpack(head) if len(head) == HEAD.size else (0, 0)
        end = at + HEAD.size + length
        if op not in _KINDS or end > self._size:
            return None
        if op == Op.CHUNK:
            is_valid = self._is_chunk(at, length)
        elif op == Op.MESSAGE_INDEX:
            index_head = self._read(at + HEAD.size, _INDEX.size)  # [1]: the length of the entries behind it
            is_valid = length >= _INDEX.size and length == _INDEX.size + _INDEX.unpack(index_head)[1]
        else:
            is_valid = self._is_exact(at, length)
        return Found(op, at, end) if is_valid else None

    def _is_chunk(self, at: int, length: int) -> bool:
        """True if the lengths in a chunk's head agree."""
        head = self._read(at + HEAD.size, CHUNK.size + _LONGEST_NAME + 8)
        if len(head) < CHUNK.size + 8 or length > LARGEST_RECORD:
            return False
        data_at = CHUNK.size + min(CHUNK.unpack_from(head)[4], _LONGEST_NAME)
        return bool(length == data_at + 8 + int.from_bytes(head[data_at : data_at + 8], "little"))

    def _is_exact(self, at: int, length: int) -> bool:
        """True if all lengths in a record agree; it has no checksum."""
        try:
            record_of(self._read(at, HEAD.size + min(length, LARGEST_RECORD)))
        except DamageError:
            return False
        return True

    def _next_chunk(self, at: int) -> int | None:
        """Return the position of the next chunk with the right checksum."""
        while at < self._size:
            part, offset = self._read(at, _SEARCHED + _OVERLAP), -1
            while (match := LOOKS_LIKE_CHUNK.search(part, offset + 1)) is not None and match.start() < _SEARCHED:
                offset = match.start()
                if (record := self._record_at(at + offset)) is not None and self._is_whole(record):
                    return at + offset
            at += _SEARCHED
        return None

    def _is_whole(self, chunk: Found) -> bool:
        try:
            for _ in records(unpack_chunk(self._read(chunk.at, chunk.end - chunk.at))):
                pass
        except DamageError:
            return False
        return True
