"""The commands that GStreamer's shmsink and shmsrc exchange on their socket. Bytes in, bytes out.

They are documented nowhere but in shmpipe.c of gst-plugins-bad: 24 bytes each, as a 64-bit machine lays out a C struct
(1.22 was tried). A connected reader is told the name of a shared memory, then of each buffer where in it it lies; it
acknowledges each by its offset when it needs it no more.
"""

import struct

from pebble.errors import PayloadError

_COMMAND = struct.Struct("@IiQQ")  # type, area, and two numbers that depend on the type
_NEW_AREA, _NEW_BUFFER, _ACK = 1, 3, 4
_AREA = 1  # the only one of a writer


def new_area(size: int, name: str) -> bytes:
    """The shared memory of ``size`` bytes that ``shm_open(name)`` opens."""
    raw = name.encode() + b"\0"
    return _COMMAND.pack(_NEW_AREA, _AREA, size, len(raw)) + raw


def new_buffer(offset: int, size: int) -> bytes:
    return _COMMAND.pack(_NEW_BUFFER, _AREA, offset, size)


class Acknowledgements:
    """Takes what a reader sends, in pieces of any size."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[int]:
        """The offsets that are acknowledged. Raises PayloadError for anything else, which no reader sends."""
        data = self._rest + data
        end = len(data) - len(data) % _COMMAND.size
        self._rest = data[end:]
        offsets = []
        for kind, area, offset, _ in _COMMAND.iter_unpack(data[:end]):
            if (kind, area) != (_ACK, _AREA):
                raise PayloadError(f"command {kind} for area {area} from a reader of a GStreamer socket")
            offsets.append(offset)
        return offsets
