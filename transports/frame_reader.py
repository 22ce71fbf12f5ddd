"""Reads the frames of a stream: the newest, never a queue of old ones."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Generic, Self, TypeVar

import numpy as np
import zenoh

from pebble.bell import Bell
from pebble.errors import TransportError
from pebble.transports import dead_pools, memlock, segments, views
from pebble.transports.counters import Counters
from pebble.transports.dead_pools import Pool
from pebble.transports.frame import Frame
from pebble.transports.frame_info import FrameInfo, decode
from pebble.transports.frame_session import METADATA, SharingError, StreamNames, open_reading
from pebble.transports.zenoh_session import check_process, close_at_exit

log = logging.getLogger(__name__)

#: Bytes of shared memory that a reader may have mapped beside the living writer's. What dead writers leave is given
#: back where that is possible; past this limit the reader has its frames sent as bytes, and says so.
LEFT_MAPPED_LIMIT = 256 << 20

_T = TypeVar("_T")


class FrameReader:
    """One reader of a stream. It may come before the writer, and survives any number of writers.

    ``views``: frames look into the writer's memory instead of copying. ``depth``: how many frames wait at most, for
    sound; it must stay below the writer's number of slots. One thread reads; any may close.

    Counters: received; missed (by the gaps in their numbers: never arrived, or after a newer one); skipped (a newer one
    came before anybody asked); of those that were read shared (through shared memory), copied (as bytes) and torn
    (overwritten while they were copied); refused (not frames); writers (how many lives of writers were seen); reopened
    (gave up shared memory).
    """

    def __init__(self, folder: Path, stream: str, *, views: bool = False, depth: int = 1) -> None:
        if depth < 1:
            raise TransportError(f"a reader of {stream} with {depth} frames would never get one")
        self._folder = folder
        self._stream = stream
        self._names = StreamNames(folder, stream)
        self._views = views
        self.counters = Counters()
        self.problem = ""
        self._lane: _Lane[_Arrival] = _Lane(depth)
        self._writers: dict[int, Pool] = {}  # the living, and what they share
        self._lives: set[int] = set()  # of writers, that were counted
        self._last: tuple[int, int] = (0, 0)  # writer and number of the newest frame that arrived
        self._former = -1  # the writer before that
        self._give_up_sharing = threading.Event()
        self._changing = threading.Lock()
        self._closed = True
        self._pid = 0
        self._session: zenoh.Session | None = None
        self._declared: list[Any] = []

    # -- opening and closing

    def open(self) -> Self:
        """Raises TransportError in a folder where no socket can be."""
        with self._changing:
            self._closed = False
            self._lane.reopen()
            self.problem = "" if memlock.lockable(needed := 2 * METADATA) else self._complaint(needed)
            self._start()
        close_at_exit(self)
        return self

    def _start(self) -> None:
        if self.problem:
            log.warning("%s", self.problem)
        session = self._session = self._open_session()
        self._pid = os.getpid()
        if self.shared and self._views:
            # The self-test takes some milliseconds: now is a better time than at the first frame. It takes memory, too,
            # which those who only hear sound are spared: that comes as bytes.
            views.why_not()
        liveliness = session.liveliness()
        # Called on Zenoh's receiving thread: these must be quick, and nothing may pile up behind them.
        on_writer = zenoh.handlers.Callback(self._on_writer, indirect=False)
        on_frame = zenoh.handlers.Callback(self._on_frame, indirect=False)
        self._declared = [
            liveliness.declare_subscriber(self._names.writers, on_writer, history=True),
            session.declare_subscriber(self._names.data, on_frame),
            liveliness.declare_token(self._names.reader(os.urandom(6).hex())),
        ]

    def _open_session(self) -> zenoh.Session:
        if not self.problem:
            try:
                return open_reading(self._folder, self._names, shared=True)
            except SharingError as error:
                self.problem = f"{error}; the frames are sent as bytes"
        return open_reading(self._folder, self._names, shared=False)

    def _stop(self) -> None:
        if self._session is None or self._pid != os.getpid():  # a session that was forked cannot even be closed
            return
        session, self._session = self._session, None
        self._declared.clear()
        self._writers.clear()
        session.close()  # type: ignore[no-untyped-call]

    def close(self) -> None:
        with self._changing:
            self._closed = True
            self._lane.close()
            self._stop()

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(self, *_: object) -> None:
        self.close()

    # -- reading

    @property
    def closed(self) -> bool:
        return self._closed

    @property
    def shared(self) -> bool:
        """False: frames are sent to this reader as bytes; `problem` says why."""
        return not self.problem

    @property
    def writers(self) -> int:
        """How many write this stream now: 0 or 1, and 2 for a moment when one takes over."""
        return len(self._writers)

    def read(self, timeout: float | None = None) -> Frame | None:
        """The newest frame not yet returned (with ``depth``: the oldest of those kept).

        None after ``timeout`` seconds without one, and when the reader is closed.
        """
        end = None if timeout is None else time.monotonic() + timeout
        while not self._closed:
            check_process(self._pid)
            if self._give_up_sharing.is_set():
                self._reopen()
            dead_pools.give_back()
            arrival = self._lane.take(end)
            frame = None if arrival is None or self._give_up_sharing.is_set() else self._frame(arrival)
            if frame is not None:
                return frame
            if arrival is None and end is not None and time.monotonic() >= end:
                return None
        return None

    def __iter__(self) -> Iterator[Frame]:
        """Until the reader is closed."""
        while not self._closed:
            frame = self.read()
            if frame is not None:
                yield frame

    def _frame(self, arrival: _Arrival) -> Frame | None:
        info, payload, pool = arrival
        buffer = payload.as_shm()
        self.counters.add("copied" if buffer is None else "shared")
        if buffer is None:
            return Frame(info, _own(bytes(payload)), shared=False)
        pool = pool or self._writers.get(info.writer)  # its first frame may come before its token does
        if pool is None or dead_pools.is_lost(pool):
            self.counters.add("torn")  # of a life that is over: nothing has kept its memory from being given back
            return None
        view = views.look(buffer, len(payload), keep=pool)
        if self._views and view is not None:
            return Frame(info, view, shared=True, buffer=buffer)
        own = _own(bytes(buffer)) if view is None else view.copy()
        if buffer.is_valid():
            return Frame(info, own, shared=True)
        self.counters.add("torn")
        return None

    # -- on Zenoh's thread

    def _on_frame(self, sample: zenoh.Sample) -> None:
        info = None if sample.attachment is None else decode(bytes(sample.attachment))
        if info is None:
            self.counters.add("refused")
            return
        writer, number = self._last
        if info.writer == writer:
            if info.sequence <= number:
                return  # bytes that a shared frame has overtaken: counted as missed when that came
            if info.sequence > number + 1:
                self.counters.add("missed", info.sequence - number - 1)
        elif info.writer == self._former:
            return  # the last words of a writer that has a successor
        else:
            self._former = writer
        self._last = (info.writer, info.sequence)
        self.counters.add("received")
        if skipped := self._lane.put((info, sample.payload, self._writers.get(info.writer))):
            self.counters.add("skipped", skipped)

    def _on_writer(self, sample: zenoh.Sample) -> None:
        try:
            life, pool = self._names.writer_of(str(sample.key_expr))
        except ValueError:
            self.counters.add("refused")
            return
        if sample.kind != zenoh.SampleKind.PUT:
            self._writers.pop(life, None)
            return
        if life not in self._lives:
            self._lives.add(life)
            self.counters.add("writers")
        self._writers[life] = pool
        if pool.size and self.shared and (problem := self._why_not_map(pool)):
            self._leave_sharing(problem)

    def _why_not_map(self, pool: Pool) -> str:
        if dead_pools.is_lost(pool):
            return f"the writer of {self._stream} was taken for dead: its frames come as bytes until one of us restarts"
        if pool.file and any(file.endswith(pool.file) for _, _, file in segments.mappings()):
            return ""  # as before: only the link was broken
        left = dead_pools.left_mapped()
        if left > LEFT_MAPPED_LIMIT:
            return (
                f"writers of {self._stream} were restarted so often that {left >> 20} MiB of their memory are lost "
                "until this process is restarted: from now on it gets frames as bytes"
            )
        needed = pool.size + METADATA
        return "" if memlock.lockable(needed) else self._complaint(needed)

    def _leave_sharing(self, problem: str) -> None:
        """A session cannot be closed from here: the next `read` does it."""
        self.problem = problem
        self._give_up_sharing.set()
        self._lane.wake()

    def _reopen(self) -> None:
        with self._changing:
            self._give_up_sharing.clear()
            if self._closed:
                return
            self.counters.add("reopened")
            self._stop()
            self._start()

    def _complaint(self, size: int) -> str:
        return memlock.complaint(size, f"a reader of {self._stream}")


_Arrival = tuple[FrameInfo, zenoh.ZBytes, Pool | None]


class _Lane(Generic[_T]):
    """The newest few, in order, from any thread to one."""

    def __init__(self, depth: int) -> None:
        self._depth = depth
        self.reopen()

    def reopen(self) -> None:
        self._items: deque[_T | None] = deque()
        self._bell = Bell()

    def put(self, item: _T) -> int:
        """Returns how many older ones this has thrown out."""
        items, thrown = self._items, 0
        items.append(item)
        while len(items) > self._depth:
            try:
                thrown += items.popleft() is not None
            except IndexError:  # taken in that moment
                break
        self._bell.ring()
        return thrown

    def take(self, end: float | None) -> _T | None:
        """The oldest of those kept; None at ``end`` (monotonic seconds) or when woken."""
        items, bell = self._items, self._bell
        while True:
            try:
                return items.popleft()
            except IndexError:
                if not bell.wait(end):
                    return None

    def wake(self) -> None:
        if not self._items:  # else it is awake
            self._items.append(None)
            self._bell.ring()

    def close(self) -> None:
        """Forget what waits: it pins the writer's memory."""
        self._items.clear()
        self._items.append(None)
        self._bell.ring()


def _own(data: bytes) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """A writable array of its own."""
    return np.frombuffer(data, np.uint8).copy()
