"""What MicroPython's stream objects have in common: reads and writes that never wait, over two primitives."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

POLLIN, POLLOUT, POLLERR, POLLHUP = 1, 4, 8, 16

_PIECE = 1024


class Stream(ABC):
    """``_receive`` and ``_send`` do one step of the work; the methods above them are those of MicroPython's streams."""

    @abstractmethod
    def _receive(self, size: int) -> bytes | None:
        """At most ``size`` bytes; None: nothing there now; b"": the other end has finished. Raises OSError."""

    @abstractmethod
    def _send(self, data: bytes) -> int | None:
        """How many bytes were taken; None: none can be taken now. Raises OSError."""

    def read(self, size: int = -1) -> bytes | None:
        """As many as there are; None if there are none, b"" at the end."""
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
        """``write(data)``, ``write(data, length)`` or ``write(data, offset, length)``; None if nothing was taken."""
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
