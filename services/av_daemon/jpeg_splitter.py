"""Cuts a stream of JPEG pictures into pictures. Bytes in, bytes out."""

from collections.abc import Iterator
from typing import Final

_START, _END = b"\xff\xd8", b"\xff\xd9"  # ISO 10918-1, table B.1
_SCAN: Final = 0xDA
_BARE = frozenset((0x01, *range(0xD0, 0xD8)))  # markers without a length: TEM and RST0 to RST7


class JpegSplitter:
    """Takes bytes as they are read. A picture longer than ``limit`` bytes, or bytes that are none, are skipped.

    Segments before the scan are stepped over by their lengths: a preview inside them has an end marker, too.
    """

    def __init__(self, limit: int = 16 << 20) -> None:
        self._limit = limit
        self._buffer = bytearray()
        self._segment = 2  # where the next segment of the first picture begins
        self._searched = 0  # in its scan the end is not before here; 0 before the scan

    def feed(self, chunk: bytes) -> list[bytes]:
        """The pictures that are complete now."""
        self._buffer += chunk
        return list(self._pictures())

    def _pictures(self) -> Iterator[bytes]:
        while self._at_start():
            end = self._end()
            if end < 0:
                self._cut(1)  # no JPEG after all: look for the next start
            elif end:
                yield bytes(self._buffer[:end])
                self._cut(end)
            elif len(self._buffer) > self._limit:
                self._cut(len(self._buffer))
            else:
                return

    def _at_start(self) -> bool:
        """Bring the start of a picture to the front; False while there is none."""
        start = self._buffer.find(_START)
        if start < 0:
            self._cut(len(self._buffer) - self._buffer.endswith(_START[:1]))
        elif start:
            self._cut(start)
        return start >= 0

    def _end(self) -> int:
        """Where the first picture ends; 0: not yet known; -1: it is none."""
        while not self._searched:
            if len(self._buffer) < self._segment + 4:
                return 0
            mark, kind = self._buffer[self._segment : self._segment + 2]
            if mark != 0xFF:
                return -1
            if kind in _BARE:
                self._segment += 2
            else:
                self._segment += 2 + int.from_bytes(self._buffer[self._segment + 2 : self._segment + 4])
                self._searched = self._segment if kind == _SCAN else 0
        found = self._buffer.find(_END, self._searched)
        self._searched = max(self._searched, len(self._buffer) - 1)
        return found + 2 if found >= 0 else 0

    def _cut(self, count: int) -> None:
        if count:
            del self._buffer[:count]
            self._segment, self._searched = 2, 0
