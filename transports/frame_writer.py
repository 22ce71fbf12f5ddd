"""Gives frames to whoever reads them, from memory that all share; rests while nobody reads."""

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
from pebble.transports import memlock, segments, views
from pebble.transports.counters import Counters
from pebble.transports.frame_info import FrameInfo, encode
from pebble.transports.frame_pool import MARGIN, Chunk, SharedPool
from pebble.transports.frame_session import METADATA, SharingError, StreamNames, open_writing
from pebble.transports.roster import Lock, prepare_run_dir
from pebble.transports.zenoh_session import check_process, close_at_exit

log = logging.getLogger(__name__)

Bytes = np.ndarray[Any, np.dtype[np.uint8]]
Data = bytes | bytearray | memoryview | np.ndarray[Any, Any]

SMALL = 16 << 10  # bytes: frames up to here travel as bytes, which is as fast and pins no memory
STARVED_S = 1.0  # this long without a free slot, and what dead or stopped readers hold is taken back
#: What becomes of a frame when a reader takes nothing; neither way stops the writer. DROP: it is dropped after a
#: millisecond, which is right for what is small: sound, and the few bytes that say where in memory a picture is.
#: A picture that goes as bytes takes longer than that: BLOCK_FIRST lets one wait and drops those after it.
_DROP, _BLOCK_FIRST = zenoh.CongestionControl.DROP, zenoh.CongestionControl.BLOCK_FIRST


class FrameWriter:
    """The one writer of a stream. Any one thread at a time may write; `wanted`, `readers` and `close` are for all.

    ``capacity`` is the size of the largest frame in bytes, ``slots`` how many of them the shared memory holds: two in
    the writer's hands and on their way, and one for every reader that keeps a frame while it works. A frame that finds
    no room travels as bytes, so that a reader that is slow, stopped or dead costs the others nothing but time.

    Counters: written; of these shared and fallbacks (no room); unwanted (nobody reads); reclaimed (how often slots had
    to be taken back from readers that died or stopped).
    """

    def __init__(self, folder: Path, stream: str, *, capacity: int, slots: int = 6) -> None:
        if capacity <= 0 or slots < 2:
            raise TransportError(f"frames of {stream}: {slots} slots of {capacity} bytes are no pool")
        self._folder = folder
        self._stream = stream
        self._names = StreamNames(folder, stream)
        self._pool_size = 0 if capacity <= SMALL else slots * capacity + MARGIN
        self.counters = Counters()
        self.problem = ""
        self._life = 0
        self._pid = 0
        self._sequence = 0
        self._starved_since: float | None = None
        self._closing = threading.Lock()
        self._session: zenoh.Session | None = None
        self._publisher: zenoh.Publisher | None = None  # of what is small
        self._bulk: zenoh.Publisher | None = None  # of pictures that go as bytes
        self._pool: SharedPool | None = None
        self._lock: Lock | None = None
        self._tokens: list[Any] = []
        self._readers: set[str] = set()

    # -- opening and closing

    def open(self) -> Self:
        """Raises TransportError if nobody can listen in that folder, for example because another writer does."""
        prepare_run_dir(self._folder)
        self._sweep()
        self.problem = self._why_not_shared()
        self._life = random.SystemRandom().getrandbits(63) | 1
        self._sequence = 0
        session = self._session = self._open_session()
        self._pid = os.getpid()
        self._lock = Lock.wait(self._names.life(self._life))  # another writer may be looking at it, sweeping
        close_at_exit(self)
        self._pool = self._make_pool()
        if self.problem:
            log.warning("%s", self.problem)
        self._publisher = self._declare_publisher(session, _DROP)
        self._bulk = self._declare_publisher(session, _BLOCK_FIRST) if self._pool_size else self._publisher
        follow = zenoh.handlers.Callback(self._on_reader, indirect=False)
        liveliness = session.liveliness()
        size, segment = (0, "") if self._pool is None else (self._pool.size, self._pool.segment())
        self._tokens = [
            liveliness.declare_subscriber(self._names.readers, follow, history=True),
            liveliness.declare_token(self._names.writer(self._life, size, segment)),
        ]
        return self

    def _declare_publisher(self, session: zenoh.Session, when_full: zenoh.CongestionControl) -> zenoh.Publisher:
        return session.declare_publisher(
            self._names.data, congestion_control=when_full, priority=zenoh.Priority.DATA_LOW
        )

    def _open_session(self) -> zenoh.Session:
        if self._pool_size and not self.problem:
            try:
                return open_writing(self._folder, self._names, shared=True)
            except SharingError as error:
                self.problem = f"{error}; the frames are sent as bytes"
        return open_writing(self._folder, self._names, shared=False)

    def _sweep(self) -> None:
        """Clear away what dead writers have left."""
        segments.sweep()
        for life in self._names.lives():
            if (lock := Lock.take(life)) is not None:
                lock.release()

    def _why_not_shared(self) -> str:
        if self._pool_size == 0 or memlock.lockable(needed := self._pool_size + 2 * METADATA):
            return ""
        return memlock.complaint(needed, f"the writer of {self._stream}")

    def _make_pool(self) -> SharedPool | None:
        if self._pool_size == 0 or self.problem:
            return None
        try:
            views.why_not()  # the self-test takes some milliseconds: now is a better time than at the first frame
            return SharedPool(self._pool_size)
        except zenoh.ZError as error:
            self.problem = f"the writer of {self._stream} cannot share memory, frames are sent as bytes: {error}"
            return None

    def close(self) -> None:
        """Readers stay, and find the next writer by themselves."""
        with self._closing:
            if self._session is None or self._pid != os.getpid():  # a session that was forked cannot even be closed
                return
            session, self._session = self._session, None
            self._publisher = self._bulk = self._pool = None
            session.close()  # type: ignore[no-untyped-call]
            self._tokens.clear()
            self._readers.clear()
            lock, self._lock = self._lock, None
            if lock is not None:
                lock.release()

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(self, *_: object) -> None:
        self.close()

    # -- who reads

    @property
    def shared(self) -> bool:
        """False: frames travel as bytes. `problem` says why, if they are not simply small."""
        return self._pool is not None

    @property
    def wanted(self) -> bool:
        """Does anybody read?"""
        return bool(self._readers)

    @property
    def readers(self) -> int:
        """How many read. One that was stopped counts until its link is given up, two seconds later."""
        return len(self._readers)

    def _on_reader(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            self._readers.add(str(sample.key_expr))
        else:
            self._readers.discard(str(sample.key_expr))

    # -- writing

    def write(self, data: Data, info: FrameInfo) -> bool:
        """Send a copy of ``data``; False if nobody reads. Never waits for a reader."""
        if not self._is_wanted():
            return False
        flat = _flat(data)
        slot = self._allocate(flat.size)
        if slot is None:
            return self._put(flat.tobytes(), info)
        slot.fill(flat)
        return self._put(slot.take(), info, shared=True)

    def slot(self, size: int) -> Slot | None:
        """Memory for a frame that is born where its readers will see it. None: use `write`.

        What is in it is left from earlier frames: fill it completely.
        """
        if self._pool is None or not self.wanted or views.why_not():
            return None
        chunk = self._allocate(size)
        return None if chunk is None else Slot(self, chunk)

    def _is_wanted(self) -> bool:
        if self._publisher is None:
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
        chunk = pool.allocate(size)
        if chunk is None and self._starving():
            pool.reclaim()
            self.counters.add("reclaimed")
            chunk = pool.allocate(size)
        if chunk is not None:
            self._starved_since = None
        return chunk

    def _starving(self) -> bool:
        """For long enough? Then the next time is as far away again."""
        now = time.monotonic()
        if self._starved_since is None:
            self._starved_since = now
        if now - self._starved_since < STARVED_S:
            return False
        self._starved_since = now
        return True

    def _put(self, payload: Any, info: FrameInfo, *, shared: bool = False) -> bool:
        publisher = self._publisher if shared else self._bulk
        if publisher is None:
            return False
        sequence = self._sequence + 1
        stamped = msgspec.structs.replace(info, sequence=sequence, writer=self._life)
        try:
            publisher.put(payload, attachment=encode(stamped))
        except zenoh.ZError as error:  # closed meanwhile
            log.debug("a frame of %s was not sent: %s", self._stream, error)
            return False
        self._sequence = sequence
        self.counters.add("written")
        if shared:
            self.counters.add("shared")
        elif self._pool is not None:
            self.counters.add("fallbacks")
        return True


class Slot:
    """Memory for one frame: fill `array`, then `send` or `drop`. After that its array must not be written to."""

    def __init__(self, writer: FrameWriter, chunk: Chunk) -> None:
        self._writer = writer
        self._chunk: Chunk | None = chunk

    @property
    def array(self) -> Bytes:
        """One-dimensional, writable, not zeroed. Raises TransportError when the slot was sent or dropped."""
        return self._take(keep=True).view()

    def send(self, info: FrameInfo) -> bool:
        """False if nobody reads any more."""
        buffer = self._take().take()
        return self._writer._is_wanted() and self._writer._put(buffer, info, shared=True)

    def drop(self) -> None:
        self._chunk = None

    def _take(self, *, keep: bool = False) -> Chunk:
        chunk = self._chunk
        if chunk is None:
            raise TransportError("this slot has been sent or dropped")
        if not keep:
            self._chunk = None
        return chunk


def _flat(data: Data) -> Bytes:
    """The same bytes as a one-dimensional array; a copy only where they do not follow each other in memory."""
    if isinstance(data, np.ndarray):
        return np.ascontiguousarray(data).reshape(-1).view(np.uint8)
    return np.frombuffer(data, np.uint8)
