"""A stand-in for GStreamer's ``shmsrc``, for tests that hold, lose and misuse buffers; it needs no GStreamer.

It is believed because `make long PART=gstreamer` has it read from Debian's own ``shmsink``.
"""

from __future__ import annotations

import mmap
import os
import select
import socket
import struct
import time
from pathlib import Path
from typing import Self

_COMMAND = struct.Struct("@IiQQ")
_NEW_AREA, _NEW_BUFFER, _ACK = 1, 3, 4


class ShmReader:
    """A program that is connected to the socket ``path``."""

    def __init__(self, path: Path) -> None:
        self.socket = socket.socket(socket.AF_UNIX)
        self.socket.settimeout(5)
        self.socket.connect(os.fspath(path))
        kind, self.area, size, length = _COMMAND.unpack(self._receive(_COMMAND.size))
        assert kind == _NEW_AREA, kind
        self.segment = Path("/dev/shm") / self._receive(length).rstrip(b"\0").decode().lstrip("/")
        descriptor = os.open(self.segment, os.O_RDONLY)
        self.memory = mmap.mmap(descriptor, size, prot=mmap.PROT_READ)
        os.close(descriptor)
        self.held: list[int] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    def take(self, timeout: float = 5.0) -> bytes | None:
        """The next buffer, held until :meth:`release`; None if none comes in time. Raises EOFError at the end."""
        if not select.select([self.socket], [], [], timeout)[0]:
            return None
        kind, area, offset, size = _COMMAND.unpack(self._receive(_COMMAND.size))
        assert (kind, area) == (_NEW_BUFFER, self.area), (kind, area)
        self.held.append(offset)
        return self.memory[offset : offset + size]

    def release(self) -> None:
        """Acknowledge the buffer that is held for longest."""
        self.socket.send(_COMMAND.pack(_ACK, self.area, self.held.pop(0), 0))

    def read(self, timeout: float = 5.0) -> bytes | None:
        """The next buffer, which is acknowledged at once."""
        data = self.take(timeout)
        if data is not None:
            self.release()
        return data

    def _receive(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            try:
                part = self.socket.recv(size - len(data))
            except ConnectionResetError:  # it was killed before it had read what this reader sent
                part = b""
            if not part:
                raise EOFError("the writer is gone")
            data += part
        return data


def connected(path: Path, timeout: float = 10.0) -> ShmReader:
    """A reader, as soon as there is a socket to connect to."""
    end = time.monotonic() + timeout
    while True:
        try:
            return ShmReader(path)
        except (FileNotFoundError, ConnectionRefusedError):
            if time.monotonic() > end:
                raise
            time.sleep(0.02)
