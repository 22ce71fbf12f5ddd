"""Non-blocking reads and writes of MicroPython's streams, built on two primitives."""

from abc import ABC, abstractmethod
from typing import Any

POLLIN, POLLOUT, POLLERR, POLLHUP = 1, 4, 8, 16


class Stream(ABC):
    """MicroPython's stream methods. Subclasses supply ``_receive`` and ``_send``, which transfer data once."""

    @abstractmethod
    def _receive(self, size: int) -> bytes | None:
        """Return at most ``size`` bytes; None if there are none now, b"" if the peer has closed. Raises OSError."""

    @abstractmethod
    def _send(self, data: bytes) -> int | None:
        """Return how many bytes were sent; None if none can be sent now. Raises OSError."""

    def read(self, size: int) -> bytes | None:
        """Return the available bytes, at most ``size``; None if there are none, b"" at the end."""
        data = b""
        while len(data) < size:
            chunk = self._receive(size - len(data))
            if not chunk:
                return data or chunk
            data += chunk
        return data

    def readinto(self, buffer: Any) -> int | None:
        view = memoryview(buffer).cast("B")
        chunk = self.read(len(view))
        if chunk is None:
            return None
        view[: len(chunk)] = chunk
        return len(chunk)

    def write(self, data: Any) -> int | None:
        """Return how many bytes were sent; None if none."""
        view, done = memoryview(data).cast("B"), 0
        while done < len(view):
            sent = self._send(bytes(view[done:]))
            if sent is None:
                return done or None
            done += sent
        return done
