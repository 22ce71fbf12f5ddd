"""Gives back the memory of writers that are dead, which Zenoh keeps mapped in their readers (zenoh #2787).

A reader's session, and closing it, have no say in that: Zenoh remembers what it has mapped for as long as the process
lives. So the mapping is replaced by nothing, at the same address, and its file by /dev/null, under the same number.
That is done only when the writer's life is certainly over, and no array, no frame and no waiting message of
that life is left in this process. What Zenoh still remembers then points to zeros, which nobody asks for any more.

Not given back is Zenoh's own 1.3 MB per writer process: its number has 16 bits, so that another process would
sooner or later get the same one.
"""

from __future__ import annotations

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
from pebble.transports.roster import Lock

log = logging.getLogger(__name__)

SETTLED_S = 1.0  # after the last reference is gone: by then Zenoh's threads have let go, too
_MAP_FIXED, _MAP_NORESERVE = 0x10, 0x4000  # the same on every Linux that Zenoh has wheels for
_libc = ctypes.CDLL(None, use_errno=True)
_libc.mmap.restype = ctypes.c_void_p
_libc.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t, *[ctypes.c_int] * 3, ctypes.c_long]


class Pool:
    """The shared memory of one life of a writer. Whatever looks into it holds on to this."""

    __slots__ = ("__weakref__", "file", "life", "size")

    def __init__(self, file: str, size: int, life: Path) -> None:
        self.file = file  # of the segment; "": not known, then it is never given back
        self.size = size  # bytes
        self.life = life  # locked by the writer as long as it lives


_given_back: set[str] = set()  # segments that read as zeros from now on
_pools: weakref.WeakValueDictionary[str, Pool] = weakref.WeakValueDictionary()
#: Segments that nobody here looks into, whose they were, and since when. A pool may die in any thread, in the midst of
#: anything, so nothing may be locked for this.
_waiting: collections.deque[tuple[str, Path, float]] = collections.deque()
_guard = threading.Lock()  # no pool comes back while it is given back


def pool(file: str, size: int, life: Path) -> Pool:
    """The same object for everybody in this process."""
    with _guard:
        known = _pools.get(file)
        if known is None:
            known = Pool(file, size, life)
            if file:
                _pools[file] = known
                weakref.finalize(known, _forgotten, file, life).atexit = False
        return known


def _forgotten(file: str, life: Path) -> None:
    _waiting.append((file, life, time.monotonic()))


def is_lost(pool: Pool) -> bool:
    """Was this given back, and has its writer turned out to be alive? It must not be looked into any more."""
    return pool.file in _given_back


def give_back() -> int:
    """Give back what can be; returns how many bytes. Costs nothing when nothing waits."""
    if not _waiting:
        return 0
    freed, alive = 0, []
    with _guard:
        now = time.monotonic()
        while _waiting and _waiting[0][2] < now - SETTLED_S:
            file, life, _ = _waiting.popleft()
            if file in _pools:
                continue  # somebody looks into it again
            if _is_over(life):
                freed += _give_back(file)
            else:  # a link that broke, or somebody else looks whether it is over, at this moment
                alive.append((file, life, now))
        _waiting.extend(alive)
    if freed:
        segments.sweep()
    return freed


def left_mapped() -> int:
    """How many bytes are mapped of segments that belong to no writer we know to be alive, Zenoh's own included."""
    known = set(_pools)
    return sum(end - start for start, end, path in segments.mappings() if Path(path).name not in known)


def _is_over(life: Path) -> bool:
    """A link that broke does not mean that the writer is dead; that its lock is free does."""
    if not life.exists():
        return True
    lock = Lock.take(life)
    if lock is None:
        return False
    lock.release()
    return True


def _give_back(file: str) -> int:
    freed = 0
    for start, end, path in segments.mappings():
        if Path(path.removesuffix(" (deleted)")).name == file:
            _given_back.add(file)
            if _replace(start, end - start):
                freed += end - start
                _redirect(path)
    log.debug("%d bytes of a dead writer's segment %s were given back", freed, file)
    return freed


def _replace(address: int, size: int) -> bool:
    """In one step: at no moment is there nothing at this address."""
    protection = mmap.PROT_READ | mmap.PROT_WRITE
    flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | _MAP_FIXED | _MAP_NORESERVE
    done: bool = _libc.mmap(address, size, protection, flags, -1, 0) == address
    if not done:
        log.warning("a dead writer's memory could not be given back: %s", os.strerror(ctypes.get_errno()))
    return done


def _redirect(path: str) -> None:
    """The descriptor through which Zenoh keeps the file, and its lock: closing it would make its number somebody's."""
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
    except OSError:  # the one that the listing itself used
        return ""
