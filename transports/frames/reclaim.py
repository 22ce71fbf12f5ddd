"""Unmaps the shared memory of dead writers, which Zenoh leaves mapped in their readers (zenoh #2787).

Closing the reader's session does not help: Zenoh remembers its mappings until the process ends. So the mapping is
replaced by zeros, at the same address, and its file by /dev/null, under the same descriptor. That is done only when the
writer has certainly ended, and no array, frame or waiting message of it is left in this process. Zenoh's references
then point to zeros, and are not used any more.

Zenoh's own 1.3 MB per writer process are not reclaimed: their segment's number has 16 bits, so that another process
would sooner or later get the same one.
"""

import collections
import ctypes
import logging
import mmap
import os
import threading
import time
import weakref
from pathlib import Path

from pebble.transports import segments
from pebble.transports.peers import FileLock

log = logging.getLogger(__name__)

GRACE_S = 1.0  # after the last reference is gone: by then Zenoh's threads have released theirs, too
_MAP_FIXED, _MAP_NORESERVE = 0x10, 0x4000  # the same on every Linux that Zenoh has wheels for
_libc = ctypes.CDLL(None, use_errno=True)
_libc.mmap.restype = ctypes.c_void_p
_libc.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t, *[ctypes.c_int] * 3, ctypes.c_long]


class WriterMemory:
    """The shared memory of one writer. Every view into it holds a reference to this."""

    __slots__ = ("__weakref__", "file", "lock_path", "size")

    def __init__(self, file: str, size: int, lock_path: Path) -> None:
        self.file = file  # of the segment; "": not known, then it is never reclaimed
        self.size = size  # bytes
        self.lock_path = lock_path  # locked by the writer while it is open


_reclaimed: set[str] = set()  # segments that read as zeros from now on
_in_use: weakref.WeakValueDictionary[str, WriterMemory] = weakref.WeakValueDictionary()
#: Segments without references here, their lock files, and since when. A finalizer may run in any thread, between any
#: two instructions, so it must not take a lock.
_released: collections.deque[tuple[str, Path, float]] = collections.deque()
_lock = threading.Lock()  # no memory is referenced anew while it is reclaimed


def writer_memory(file: str, size: int, lock_path: Path) -> WriterMemory:
    """The one object per segment in this process."""
    with _lock:
        known = _in_use.get(file)
        if known is None:
            known = WriterMemory(file, size, lock_path)
            if file:
                _in_use[file] = known
                weakref.finalize(known, _on_released, file, lock_path).atexit = False
        return known


def _on_released(file: str, lock_path: Path) -> None:
    _released.append((file, lock_path, time.monotonic()))


def is_reclaimed(memory: WriterMemory) -> bool:
    """Whether this was reclaimed, although its writer turned out to be running: it must not be read any more."""
    return memory.file in _reclaimed


def reclaim() -> int:
    """Reclaim what is possible; return how many bytes. Costs nothing when nothing was released."""
    if not _released:
        return 0
    freed, retry = 0, []
    with _lock:
        now = time.monotonic()
        while _released and _released[0][2] < now - GRACE_S:
            file, lock_path, _ = _released.popleft()
            if file in _in_use:
                continue  # referenced again
            if _is_dead(lock_path):
                freed += _reclaim_segment(file)
            else:  # only the connection was lost, or another process is checking the lock
                retry.append((file, lock_path, now))
        _released.extend(retry)
    if freed:
        segments.sweep()
    return freed


def unclaimed_bytes() -> int:
    """How many bytes are mapped of segments without references here, Zenoh's own included."""
    known = set(_in_use)
    return sum(end - start for start, end, path in segments.mappings() if Path(path).name not in known)


def _is_dead(lock_path: Path) -> bool:
    """A lost connection does not mean that the writer is dead; a free lock does."""
    if not lock_path.exists():
        return True
    lock = FileLock.take(lock_path)
    if lock is None:
        return False
    lock.release()
    return True


def _reclaim_segment(file: str) -> int:
    freed = 0
    for start, end, path in segments.mappings():
        if Path(path.removesuffix(" (deleted)")).name == file:
            _reclaimed.add(file)
            if _map_zeros(start, end - start):
                freed += end - start
                _redirect_descriptors(path)
    log.debug("%d bytes of a dead writer's segment %s were reclaimed", freed, file)
    return freed


def _map_zeros(address: int, size: int) -> bool:
    """Replace the mapping in one step: the address is valid at every moment."""
    protection = mmap.PROT_READ | mmap.PROT_WRITE
    flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | _MAP_FIXED | _MAP_NORESERVE
    done: bool = _libc.mmap(address, size, protection, flags, -1, 0) == address
    if not done:
        log.warning("a dead writer's memory could not be reclaimed: %s", os.strerror(ctypes.get_errno()))
    return done


def _redirect_descriptors(path: str) -> None:
    """Redirect Zenoh's descriptor of the file: closing it would free its number for another file."""
    nothing = os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC)
    try:
        for link in Path("/proc/self/fd").iterdir():
            if _target(link) == path:
                os.dup2(nothing, int(link.name), inheritable=False)
    finally:
        os.close(nothing)


def _target(link: Path) -> str:
    try:
        return str(link.readlink())
    except OSError:  # the one of the listing itself
        return ""
