"""Non-blocking reads and writes of MicroPython's stream objects, over two primitives."""

from abc import ABC, abstractmethod
from typing import Any

POLLIN, POLLOUT, POLLERR, POLLHUP = 1, 4, 8, 16

_PIECE = 1024


class Stream(ABC):
    """MicroPython's stream methods, over ``_receive`` and ``_send``, which transfer once."""

    @abstractmethod
    def _receive(self, size: int) -> bytes | None:
        """Return at most ``size`` bytes; None: none now; b"": the peer has closed. Raises OSError."""

    @abstractmethod
    def _send(self, data: bytes) -> int | None:
        """Return how many bytes were sent; None: none can be sent now. Raises OSError."""

    def read(self, size: int = -1) -> bytes | None:
        """Return the available bytes; None if there are none, b"" at the end."""
        parts: list[bytes] = []
        left = size
        while left:
            got = self._receive(_PIECE if left < 0 else left)
            if not got:
                return b"".join(parts) if parts else got
            parts.append(got)
            left -= len(got) if left > 0 else 0
        return b"".join(parts)

    def readinto(self, buffer: Any, size: int | None = None) -> int | None:
        view = memoryview(buffer).cast("B")
        got = self.read(len(view) if size is None else min(size, len(view)))
        if got is None:
            return None
        view[: len(got)] = got
        return len(got)

    def write(self, data: Any, *span: int) -> int | None:
        """``write(data)``, ``write(data, length)`` or ``write(data, offset, length)``; None if nothing was sent."""
        view = memoryview(data.encode() if isinstance(data, str) else data).cast("B")
        offset, length = ([0, *span] if len(span) < 2 else list(span)) if span else (0, len(view))
        view = view[offset : offset + length]
        done = 0
        while done < len(view):
            sent = self._send(bytes(view[done:]))
            if sent is None:
                return done or None
            done += sent
        return done
