"""The memory that a writer shares, and the pieces of it that become frames."""

from __future__ import annotations

import contextlib
import re
from typing import Any

import numpy as np
import zenoh
import zenoh.shm

from pebble.errors import TransportError
from pebble.transports import views

Bytes = np.ndarray[Any, np.dtype[np.uint8]]

MARGIN = 64 << 10  # bytes beyond the frames: the allocator's own, and rounding
_segment = re.compile(r"\bsegment: (\d+),").search


class SharedPool:
    """Shared memory in one piece. Raises ZError if there is none."""

    def __init__(self, size: int) -> None:
        self.size = size
        self._provider = zenoh.shm.ShmProvider.default_backend(size)
        self._policy = zenoh.shm.GarbageCollect()

    def segment(self) -> str:
        """The name of the file in /dev/shm; "" if Zenoh does not say."""
        found = _segment(repr(self._provider.alloc(1, policy=self._policy)))
        return f"{found[1]}.zenoh" if found else ""

    def allocate(self, size: int) -> Chunk | None:
        for _ in range(2):  # Zenoh gives up if no single chunk that it collects is large enough; together they may be
            with contextlib.suppress(zenoh.ZError):
                return Chunk(self._provider.alloc(size, policy=self._policy), size, self._provider)
        return None

    def reclaim(self) -> None:
        """Take back what was not confirmed by a living reader for a tenth of a second."""
        self._provider.garbage_collect_unsafe()


class Chunk:
    """One frame's piece of it: seen as an array, then taken to be sent."""

    def __init__(self, buffer: Any, size: int, provider: Any) -> None:
        self._buffer = buffer
        self._size = size
        self._provider = provider
        self._view: Bytes | None = None

    def view(self) -> Bytes:
        """The provider stays alive as long as the array: what was sent is still mapped, whoever looks at it."""
        if self._view is None:
            self._view = views.look(self._buffer, self._size, writable=True, keep=self._provider)
            if self._view is None:
                raise TransportError(f"no view into shared memory: {views.why_not()}")
        return self._view

    def fill(self, data: Bytes) -> None:
        if views.why_not():
            self._buffer[:] = data.tobytes()
        else:
            self.view()[:] = data

    def take(self) -> Any:
        return self._buffer
