"""Splits a stream of bytes into JPEG pictures. Bytes in, bytes out."""

from typing import Final

_START, _END = b"\xff\xd8", b"\xff\xd9"  # ISO 10918-1, table B.1
_SCAN: Final = 0xDA
_BARE = frozenset((0x01, *range(0xD0, 0xD8)))  # markers without a length: TEM and RST0 to RST7


class JpegSplitter:
    """A splitter. It skips pictures longer than ``limit`` bytes, and bytes that belong to no picture."""

    def __init__(self, limit: int = 16 << 20) -> None:
        self._limit = limit
        self._buffer = bytearray()

    def feed(self, chunk: bytes) -> list[bytes]:
        """Return the pictures that ``chunk`` completes."""
        buffer, pictures = self._buffer, []
        buffer += chunk
        while True:
            start = buffer.find(_START)
            if start < 0:
                start = len(buffer)
                if buffer.endswith(_START[:1]):  # the beginning of a start, perhaps
                    start -= 1
            del buffer[:start]
            end = _end(buffer)  # 0: not known yet; -1: what begins here is no picture
            if end > 0:
                pictures.append(bytes(buffer[:end]))
            elif end == 0:  # the rest is still to come
                if len(buffer) > self._limit:
                    buffer.clear()
                return pictures
            del buffer[: end if end > 0 else 1]  # of no picture only the first byte: another may begin in it


def _end(buffer: bytearray) -> int:
    """Return the end of the first picture; 0: not yet known; -1: the bytes are no picture.

    Segments before the scan are skipped by their lengths: a preview inside them has an end marker, too.
    """
    at = len(_START)
    while at + 4 <= len(buffer):
        mark, kind = buffer[at : at + 2]
        if mark != 0xFF:
            return -1
        at += 2 if kind in _BARE else 2 + int.from_bytes(buffer[at + 2 : at + 4])
        if kind == _SCAN:
            end = buffer.find(_END, at)
            return end + len(_END) if end >= 0 else 0
    return 0
