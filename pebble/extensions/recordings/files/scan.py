"""A scan for the records of a file without a summary, from its beginning to its end, also after damage."""

from collections.abc import Callable, Iterator
from typing import Final, NamedTuple

from pebble.extensions.recordings.files.recorded import Damage, DamageError, RecordingError
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

_CHECKSUM: Final = 4  # bytes
_LONGEST_NAME: Final = 16  # of a compression
_SEARCHED, _OVERLAP = 1 << 20, 64  # bytes behind damage that are read at once

#: Takes a position and a length; there may be less.
Read = Callable[[int, int], bytes]


class Found(NamedTuple):
    """A record that was found, with its place."""

    op: int
    at: int
    end: int


class Scan:
    """A scan that continues where it ended, when the file has grown.

    ``name``: the file's, for errors; ``is_ours``: it is a file of ours, in which records that we never write count as
    damage.
    """

    def __init__(self, name: object, read: Read, damage: Damage, *, is_ours: bool) -> None:
        self._name, self._read, self._damage, self._is_ours = name, read, damage, is_ours
        self._at = len(MAGIC)  # what was looked at ends here
        self._searched = 0  # no chunk begins before
        self._size, self._ended = 0, False

    @property
    def is_cut_off(self) -> bool:
        """True if only zeros, or the beginning of a record, follow the last record, as after a kill."""
        rest = self._read(self._at, min(self._damage.torn, LARGEST_RECORD))
        if len(rest) < HEAD.size or not any(rest):
            return len(rest) >= self._damage.torn
        op, length = HEAD.unpack_from(rest)
        return self._may_begin(op, length) and self._at + HEAD.size + length > self._size

    def records(self, size: int) -> Iterator[Found]:
        """Yield the records of a file of ``size`` bytes that were not yielded before.

        Raises RecordingError for a file whose messages are not in chunks.
        """
        self._size = size
        while self._at < size and not self._ended:
            record = self._record_at(self._at)
            if record is None:
                next_chunk = self._next_chunk(max(self._at + 1, self._searched))
                if next_chunk is None:
                    self._searched = max(self._searched, size - _OVERLAP)
                    break
                self._damage.add(self._at, f"{next_chunk - self._at:,} bytes are no record")
                self._at = next_chunk
                continue
            found_record = Found(record[0], self._at, record[1])
            self._at, self._ended = found_record.end, found_record.op == Op.DATA_END
            yield found_record
        self._damage.torn = 0 if self._ended else max(0, size - self._at)

    def _record_at(self, at: int) -> tuple[int, int] | None:
        """Return the opcode and the end of the record at ``at``; None if there is no complete record."""
        head = self._read(at, HEAD.size)
        if len(head) < HEAD.size:
            return None
        op, length = HEAD.unpack_from(head)
        end = at + HEAD.size + length
        if end > self._size:
            return None
        if op == Op.CHUNK:
            is_one = self._is_chunk(at, length)
        elif op == Op.CHANNEL:
            is_one = self._is_channel(at, length)
        elif op == Op.DATA_END:
            is_one = length == _CHECKSUM
        elif op == Op.MESSAGE and not self._is_ours:
            raise RecordingError(f"{self._name}: its messages are not in chunks: `mcap compress` puts them there")
        else:
            is_one = self._may_begin(op, length) and self._begins_record(end)
        return (op, end) if is_one else None

    def _begins_record(self, at: int) -> bool:
        """True if a record may begin at ``at``, or the file ends there."""
        head = self._read(at, HEAD.size)
        return len(head) < HEAD.size or self._may_begin(*HEAD.unpack(head))

    def _may_begin(self, op: int, length: int) -> bool:
        is_known = Op.HEADER <= op <= Op.DATA_END or op == Op.PADDING or (op > 0 and not self._is_ours)
        return is_known and length < 1 << 32

    def _is_chunk(self, at: int, length: int) -> bool:
        """True if the lengths in a chunk's head agree."""
        head = self._read(at + HEAD.size, CHUNK.size + _LONGEST_NAME + 8)
        if len(head) < CHUNK.size + 8 or length > LARGEST_RECORD:
            return False
        data_at = CHUNK.size + min(CHUNK.unpack_from(head)[4], _LONGEST_NAME)
        return bool(length == data_at + 8 + int.from_bytes(head[data_at : data_at + 8], "little"))

    def _is_channel(self, at: int, length: int) -> bool:
        """True if a channel's lengths agree exactly; it has no checksum."""
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
                if (record := self._record_at(at + offset)) is not None and self._is_whole(at + offset, record[1]):
                    return at + offset
            at += _SEARCHED
        return None

    def _is_whole(self, at: int, end: int) -> bool:
        try:
            for _ in records(unpack_chunk(self._read(at + HEAD.size, end - at - HEAD.size))):
                pass
        except DamageError:
            return False
        return True
