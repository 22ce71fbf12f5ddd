"""The shared memory of a frame writer, and the system's limit on the memory that a process may lock."""

from __future__ import annotations

import contextlib
import ctypes
import mmap
import re
import resource
import time
from typing import Any

import zenoh
import zenoh.shm

from pebble.errors import TransportError
from pebble.extensions.media.frames import views
from pebble.extensions.media.frames.frame import Bytes

STARVED_S = 1.0  # after this long without a free slot, slots of dead or stopped readers are reclaimed
MARGIN = 64 << 10  # bytes in addition to the frames: the allocator's own, and rounding
_MLOCK_ONFAULT = 1  # checks the permission without touching the pages (Linux 4.4)
_libc = ctypes.CDLL(None, use_errno=True)
_segment = re.compile(r"\bsegment: (\d+),").search


class SharedPool:
    """A segment of shared memory that frames are allocated from. Raises ZError if it cannot be created."""

    def __init__(self, size: int) -> None:
        self.size = size
        self._provider = zenoh.shm.ShmProvider.default_backend(size)
        self._policy = zenoh.shm.GarbageCollect()
        self._starved_since: float | None = None  # since when no slot was free
        self.reclaimed = 0  # how often slots were taken from readers that died or stopped

    def segment(self) -> str:
        """Return the name of its file in /dev/shm; "" if Zenoh does not report it."""
        match = _segment(repr(self._provider.alloc(1, policy=self._policy)))  # Zenoh prints it for each allocation
        return f"{match[1]}.zenoh" if match else ""

    def allocate(self, size: int) -> Chunk | None:
        """Return memory for a frame of ``size`` bytes; None if no slot is free."""
        chunk = self._allocate(size)
        if chunk is None and self._starving():
            self._provider.garbage_collect_unsafe()  # what no running reader has confirmed for 0.1 s
            self.reclaimed += 1
            chunk = self._allocate(size)
        if chunk is not None:
            self._starved_since = None
        return chunk

    def _allocate(self, size: int) -> Chunk | None:
        for _ in range(2):  # Zenoh fails if no single collected chunk is large enough; joined ones may be, next time
            with contextlib.suppress(zenoh.ZError):
                return Chunk(self._provider.alloc(size, policy=self._policy), size, self._provider)
        return None

    def _starving(self) -> bool:
        """True, once, if no slot was free for STARVED_S; then the time starts again."""
        now = time.monotonic()
        if self._starved_since is None:
            self._starved_since = now
        if now - self._starved_since < STARVED_S:
            return False
        self._starved_since = now
        return True


class Chunk:
    """The memory of one frame: filled as an array, then sent as a Zenoh buffer."""

    def __init__(self, buffer: Any, size: int, provider: Any) -> None:
        self._buffer = buffer
        self._size = size
        self._provider = provider
        self._view: Bytes | None = None

    def view(self) -> Bytes:
        """Return the memory as an array, which holds Zenoh's provider: the memory stays mapped after sending."""
        if self._view is None:
            self._view = views.array(self._buffer, self._size, writable=True, owner=self._provider)
            if self._view is None:
                raise TransportError(f"no view into shared memory: {views.why_unavailable()}")
        return self._view

    def fill(self, data: Bytes) -> None:
        if views.why_unavailable():
            self._buffer[:] = data.tobytes()
        else:
            self.view()[:] = data

    def take(self) -> Any:
        return self._buffer


def lockable(size: int) -> bool:
    """True if this process may lock ``size`` more bytes.

    Zenoh locks the memory that it shares; a reader that may not lock loses every shared frame without an error.
    """
    if not hasattr(_libc, "mlock2"):
        return resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY
    with mmap.mmap(-1, size) as memory:
        probe = ctypes.c_char.from_buffer(memory)
        address = ctypes.c_void_p(ctypes.addressof(probe))
        allowed = _libc.mlock2(address, ctypes.c_size_t(size), _MLOCK_ONFAULT) == 0
        _libc.munlock(address, ctypes.c_size_t(size))
        del probe  # else the mapping could not be closed
    return bool(allowed)


def memlock_problem(size: int, what: str) -> str:
    """Return a sentence for logs: why ``what`` cannot share memory, as it is not ``lockable(size)``, and what to do."""
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    return (
        f"{what} cannot use shared memory, frames are sent as bytes: this process may lock {limit >> 10} KiB "
        f"and needs {size >> 10} KiB more; set LimitMEMLOCK=infinity in its systemd unit, or `ulimit -l unlimited`"
    )
