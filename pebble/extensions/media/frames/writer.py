"""Writes frames to the readers of a stream, through shared memory; sends nothing while there are no readers."""

from __future__ import annotations

import logging
import os
import random
import threading
import time
from pathlib import Path
from typing import Any, Self

import msgspec
import numpy as np
import zenoh

from pebble.errors import TransportError
from pebble.extensions.media.frames import memory, shared_memory, views
from pebble.extensions.media.frames.frame import Bytes, FrameInfo, encode
from pebble.extensions.media.frames.session import METADATA, SharingError, StreamNames, open_writing
from pebble.extensions.media.frames.shared_memory import MARGIN, Chunk, SharedPool
from pebble.transports import segments
from pebble.transports.counters import Counters
from pebble.transports.peers import FileLock, prepare_run_dir
from pebble.transports.zenoh.session import check_process, close_at_exit, close_session

log = logging.getLogger(__name__)

Data = bytes | bytearray | memoryview | np.ndarray[Any, Any]

SMALL = 16 << 10  # bytes: frames up to this size are sent as bytes, which is as fast and pins no memory
RETRY_S = 30.0  # from the opening without room in shared memory until it is looked for again
_NEVER = float("inf")
#: What happens to a frame when a reader accepts nothing; neither blocks the writer. DROP: it is dropped after a
#: millisecond, which is right for small messages: sound, and the reference to a picture in shared memory.
#: A picture sent as bytes takes longer than that: BLOCK_FIRST lets one wait and drops those after it.
_DROP, _BLOCK_FIRST = zenoh.CongestionControl.DROP, zenoh.CongestionControl.BLOCK_FIRST


class FrameWriter:
    """The writer of a stream. One thread at a time may write; `wanted`, `readers` and `close` work on any thread.

    ``capacity`` is the size of the largest frame in bytes. ``slots`` is the number of frames that the shared memory
    holds: two that are written or on their way, and one for each reader that holds a frame while it works. If no slot
    is free, a frame is sent as bytes, so that a slow, stopped or dead reader costs the others only time.

    Counters: written; of these shared and fallbacks (no room); unwanted (no readers); reclaimed (how often slots had to
    be reclaimed from readers that died or stopped).
    """

    def __init__(self, folder: Path, stream: str, *, capacity: int, slots: int = 6) -> None:
        if capacity <= 0 or slots < 2:
            raise TransportError(f"frames of {stream}: {slots} slots of {capacity} bytes are no pool")
        self._names = StreamNames(folder, stream)
        self._pool_size = 0 if capacity <= SMALL else slots * capacity + MARGIN
        self.counters = Counters()
        self.problem = ""
        self._retry_at = _NEVER  # when room in shared memory is looked for again
        self._writer_id = 0  # of the present opening
        self._pid = 0  # of the process that opened the session: no fork of it can use it
        self._sequence = 0  # the number of the newest frame
        self._closing = threading.Lock()
        self._session: zenoh.Session | None = None
        #: For small messages, and for pictures sent as bytes.
        self._publishers: tuple[zenoh.Publisher, zenoh.Publisher] | None = None
        self._pool: SharedPool | None = None
        self._lock: FileLock | None = None  # held while open: it shows that this writer is not dead
        self._memory: Path | None = None  # the pool's file
        self._tokens: list[Any] = []  # by which readers see this writer, and it sees them
        self._readers: set[str] = set()  # keys of their tokens

    # -- opening and closing

    def open(self) -> Self:
        """Open the writer. Raises TransportError if it cannot listen, for example beside another writer."""
        prepare_run_dir(self._names.folder)
        self._sweep()
        self.problem = self._why_not_shared()
        self._writer_id = random.SystemRandom().getrandbits(63) | 1  # never 0, which is no writer
        self._sequence = 0
        session = self._session = self._open_session()
        self._pid = os.getpid()
        self._lock = FileLock.wait(self._names.lock_path(self._writer_id))  # another writer may be checking it
        close_at_exit(self)
        self._pool = self._make_pool()
        self._retry_at = _NEVER
        if self.problem:
            log.warning("%s", self.problem)
            if not self._has_room():  # which may change: see may_share
                self._retry_at = time.monotonic() + RETRY_S
        small = self._declare_publisher(session, _DROP)  # for sound, and for references to shared memory
        # For pictures that are sent as bytes; a writer of sound has none.
        pictures = self._declare_publisher(session, _BLOCK_FIRST) if self._pool_size else small
        self._publishers = small, pictures
        follow = zenoh.handlers.Callback(self._on_reader, indirect=False)
        liveliness = session.liveliness()
        size, segment = (0, "") if self._pool is None else (self._pool.size, self._pool.segment())
        self._tokens = [
            liveliness.declare_subscriber(self._names.readers, follow, history=True),
            liveliness.declare_token(self._names.writer(self._writer_id, size, segment)),
        ]
        self._memory = segments.SHM / segment if segment else None
        return self

    @property
    def in_place(self) -> bool:
        """True unless the shared memory was removed, as at a user's logout: readers that start now get nothing then."""
        return self._memory is None or self._memory.exists()

    @property
    def may_share(self) -> bool:
        """True if shared memory had no room when this writer was opened, and now has: another writer could share."""
        return time.monotonic() >= self._retry_at and self._has_room()

    def _has_room(self) -> bool:
        return memory.has_room(self._pool_size + 2 * METADATA)

    def _declare_publisher(self, session: zenoh.Session, when_full: zenoh.CongestionControl) -> zenoh.Publisher:
        return session.declare_publisher(
            self._names.data, congestion_control=when_full, priority=zenoh.Priority.DATA_LOW
        )

    def _open_session(self) -> zenoh.Session:
        if self._pool_size and not self.problem:
            try:
                return open_writing(self._names, shared=True)
            except SharingError as error:
                self.problem = f"{error}; the frames are sent as bytes"
        return open_writing(self._names, shared=False)

    def _sweep(self) -> None:
        """Remove the segments and lock files of dead writers."""
        segments.sweep()
        for lock_path in self._names.lock_paths():
            if (lock := FileLock.take(lock_path)) is not None:
                lock.release()

    def _why_not_shared(self) -> str:
        needed = self._pool_size + 2 * METADATA
        if self._pool_size == 0 or shared_memory.lockable(needed):
            return ""
        return shared_memory.memlock_problem(needed, f"the writer of {self._names.stream}")

    def _make_pool(self) -> SharedPool | None:
        if self._pool_size == 0 or self.problem:
            return None
        try:
            views.why_unavailable()  # the self-test takes milliseconds: better now than at the first frame
            return SharedPool(self._pool_size)
        except zenoh.ZError as error:
            self.problem = f"the writer of {self._names.stream} cannot share memory, frames are sent as bytes: {error}"
            return None

    def close(self) -> None:
        """Close the writer. Readers stay open, and find the next writer by themselves."""
        with self._closing:
            if self._session is None or self._pid != os.getpid():  # a forked session cannot even be closed
                return
            session, self._session = self._session, None
            self._publishers = self._pool = None
            close_session(session)
            self._tokens.clear()
            self._readers.clear()
            if self._lock is not None:
                self._lock.release()

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(self, *_: object) -> None:
        self.close()

    # -- readers

    @property
    def shared(self) -> bool:
        """True if frames are sent through shared memory. If not, `problem` explains why, unless frames are small."""
        return self._pool is not None

    @property
    def wanted(self) -> bool:
        return bool(self._readers)

    @property
    def readers(self) -> int:
        """Number of readers. A stopped reader counts until its connection is closed, two seconds later."""
        return len(self._readers)

    def _on_reader(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            self._readers.add(str(sample.key_expr))
        else:
            self._readers.discard(str(sample.key_expr))

    # -- writing

    def write(self, data: Data, info: FrameInfo) -> bool:
        """Send a copy of ``data``; False if there are no readers. Never waits for a reader."""
        if not self._is_wanted():
            return False
        flat = _flat(data)
        slot = self._allocate(flat.size)
        if slot is None:
            return self._put(flat.tobytes(), info)
        slot.fill(flat)
        return self._put(slot.take(), info, shared=True)

    def slot(self, size: int) -> Slot | None:
        """Return shared memory in which to build a frame without a copy; None if there is none: use `write`.

        It contains data of earlier frames: fill it completely.
        """
        if self._pool is None or not self.wanted or views.why_unavailable():
            return None
        chunk = self._allocate(size)
        return None if chunk is None else Slot(self, chunk)

    def _is_wanted(self) -> bool:
        """True if the stream is open and has readers. A frame without readers is counted as unwanted."""
        if self._publishers is None:
            return False
        check_process(self._pid)
        if not self._readers:
            self.counters.add("unwanted")
            return False
        return True

    def _allocate(self, size: int) -> Chunk | None:
        pool = self._pool
        if pool is None or size <= 0:
            return None
        before = pool.reclaimed
        chunk = pool.allocate(size)
        if pool.reclaimed != before:
            self.counters.add("reclaimed")
        return chunk

    def _put(self, payload: Any, info: FrameInfo, *, shared: bool = False) -> bool:
        """Send a frame; False if this is closed. ``shared``: it is in shared memory, and ``payload`` refers to it."""
        publishers = self._publishers
        if publishers is None:
            return False
        small, pictures = publishers
        sequence = self._sequence + 1
        stamped = msgspec.structs.replace(info, sequence=sequence, writer=self._writer_id)
        try:
            publisher = small if shared else pictures  # what is sent of a shared frame is a reference to it
            publisher.put(payload, attachment=encode(stamped))
        except zenoh.ZError as error:  # closed meanwhile
            log.debug("a frame of %s was not sent: %s", self._names.stream, error)
            return False
        self._sequence = sequence
        self.counters.add("written")
        if shared:
            self.counters.add("shared")
        elif self._pool is not None:  # which had no room
            self.counters.add("fallbacks")
        return True


class Slot:
    """Memory for one frame: fill `array`, then `send` it, or forget it. After that its array must not be written to."""

    def __init__(self, writer: FrameWriter, chunk: Chunk) -> None:
        self._writer = writer
        self._chunk: Chunk | None = chunk

    @property
    def array(self) -> Bytes:
        """One-dimensional, writable array, not zeroed. Raises TransportError when the slot was sent."""
        return self._held().view()

    def send(self, info: FrameInfo) -> bool:
        """Send the frame; False if there are no readers left."""
        buffer = self._held().take()
        self._chunk = None
        return self._writer._is_wanted() and self._writer._put(buffer, info, shared=True)

    def _held(self) -> Chunk:
        if self._chunk is None:
            raise TransportError("this slot has been sent")
        return self._chunk


def _flat(data: Data) -> Bytes:
    """Return the bytes of ``data`` as a one-dimensional array; they are copied only if they are not contiguous."""
    if isinstance(data, np.ndarray):
        return np.ascontiguousarray(data).reshape(-1).view(np.uint8)
    return np.frombuffer(data, np.uint8)
