"""Reads the newest frames of a stream; older ones are skipped."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

import numpy as np
import zenoh

from pebble.errors import TransportError
from pebble.extensions.media.frames import memory, shared_memory, views
from pebble.extensions.media.frames.frame import Bytes, Frame, FrameInfo, decode
from pebble.extensions.media.frames.session import METADATA, SharingError, StreamNames, open_reading
from pebble.transports.counters import Counters
from pebble.transports.peers import prepare_run_dir
from pebble.transports.wakeup import Wakeup
from pebble.transports.zenoh.callbacks import direct
from pebble.transports.zenoh.session import check_process, close_at_exit, close_session

log = logging.getLogger(__name__)

#: Bytes that a reader may have mapped. Zenoh leaves the memory of dead writers mapped until the process ends (zenoh
#: #2787): beyond this limit the reader receives frames as bytes, and `problem` explains it.
MAPPED_LIMIT = 256 << 20


class FrameReader:
    """A reader of one stream. It may open before the writer, and continues with every new writer.

    ``views``: frames are views of the writer's memory instead of copies. ``sharing``: frames may come
    through shared memory. Without it Zenoh (1.10.2) takes 8 MB less; so it is False for sound, which comes as bytes
    anyway. ``depth``: the most frames that wait, for sound; it must be below the writer's number of slots. One thread
    reads; any may close.

    Counters: received; missed (gaps in the numbers: lost, or overtaken by a newer one); skipped (replaced by a newer
    one before it was read); of the frames that were read: shared (through shared memory), copied (as bytes), torn
    (overwritten while they were copied); refused (not frames); writers (how many were seen; a restarted one counts
    again); reopened (to begin or to stop using shared memory).
    """

    def __init__(self, folder: Path, stream: str, *, views: bool = False, sharing: bool = True, depth: int = 1) -> None:
        if depth < 1:
            raise TransportError(f"a reader of {stream} with {depth} frames would never get one")
        self._names = StreamNames(folder, stream)
        self._views, self._sharing = views, sharing
        self.counters = Counters()
        self._count_received, self._count_shared = map(self.counters.adder, ("received", "shared"))
        self.problem = ""
        self._latest = _LatestFrames(depth)  # closed while the reader is
        self.running: set[int] = set()  # ids of writers
        self._seen: set[int] = set()  # ids of writers that were counted
        self._newest = 0, 0  # writer and number of the newest frame that has arrived
        self._replaced = -1  # the writer before that of the newest frame
        self._must_reopen = threading.Event()  # to begin or to stop using shared memory
        self._lacked_room = False  # in shared memory, when the session was opened
        self._changing = threading.Lock()  # held while the reader is opened, reopened or closed
        self._pid = 0  # of the process that opened the session: no fork of it can use it
        self._session: tuple[zenoh.Session, list[Any]] | None = None  # and what is declared there

    # -- opening and closing

    def open(self) -> Self:
        """Open the reader. Raises TransportError if the folder is another user's, or its path too long for a socket."""
        prepare_run_dir(self._names.folder)
        with self._changing:
            self._latest.reopen()
            needed = 2 * METADATA  # the reader's own, and that of a writer, which is mapped as well
            lockable = not self._sharing or shared_memory.lockable(needed)
            self.problem = "" if lockable else self._memlock_problem(needed)
            self._start()
        close_at_exit(self)
        return self

    def _start(self) -> None:
        if self.problem:
            log.warning("%s", self.problem)
        session = self._open_session()
        self._pid = os.getpid()
        if self.shared and self._views:
            # The self-test takes milliseconds: better now than at the first frame.
            views.why_unavailable()
        liveliness = session.liveliness()
        declared = [  # called on Zenoh's receiving thread: these must be quick
            liveliness.declare_subscriber(self._names.writers, direct(self._on_writer), history=True),
            session.declare_subscriber(self._names.data, direct(self._on_frame)),
            liveliness.declare_token(self._names.reader(os.urandom(6).hex())),
        ]
        self._session = session, declared

    def _open_session(self) -> zenoh.Session:
        if self.shared:
            try:
                return open_reading(self._names, shared=True)
            except SharingError as error:
                self.problem = f"{error}; the frames are sent as bytes"
                self._lacked_room = True
        return open_reading(self._names, shared=False)

    def _stop(self) -> None:
        if self._session is None or self._pid != os.getpid():  # a forked session cannot even be closed
            return
        (session, declared), self._session = self._session, None
        declared.clear()
        self.running.clear()
        close_session(session)

    def close(self) -> None:
        with self._changing:
            self._latest.close()
            self._stop()

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(self, *_: object) -> None:
        self.close()

    # -- reading

    @property
    def closed(self) -> bool:
        return self._latest.closed

    @property
    def shared(self) -> bool:
        """True if frames come through shared memory. If not, `problem` explains why, unless ``sharing`` is False."""
        return self._sharing and not self.problem

    @property
    def writers(self) -> int:
        """Number of writers of the stream now: 0 or 1, or 2 for a moment when one replaces another."""
        return len(self.running)

    def read(self, timeout: float | None = None) -> Frame | None:
        """Return the newest frame that was not returned before; with ``depth``, the oldest of those that wait.

        None if there is none within ``timeout`` seconds, or if the reader is closed.
        """
        end = None if timeout is None else time.monotonic() + timeout
        while not self._latest.closed:
            check_process(self._pid)
            if self._must_reopen.is_set():
                self._reopen()
            arrival = self._latest.take(end)
            if arrival is None:
                if end is not None and time.monotonic() >= end:
                    return None
            elif not self._must_reopen.is_set():  # else the frame may be in memory that must not be mapped
                frame = self._frame(arrival)
                if frame is not None:
                    return frame
        return None

    def __iter__(self) -> Iterator[Frame]:
        """Iterate over frames until the reader is closed."""
        while not self._latest.closed:
            frame = self.read()
            if frame is not None:
                yield frame

    def _frame(self, arrival: _Arrival) -> Frame | None:
        """Return the frame that has arrived; None if its memory was overwritten meanwhile."""
        info, payload = arrival
        buffer = payload.as_shm()
        if buffer is None:
            self.counters.add("copied")
            return Frame(info, _copy(bytes(payload)), shared=False)
        self._count_shared()
        view = views.array(buffer, len(payload))
        if self._views and view is not None:
            return Frame(info, view, shared=True, buffer=buffer)
        copy = _copy(bytes(buffer)) if view is None else view.copy()
        if buffer.is_valid():
            return Frame(info, copy, shared=True)
        self.counters.add("torn")
        return None

    # -- on Zenoh's thread

    def _on_frame(self, sample: zenoh.Sample) -> None:
        attachment = sample.attachment
        info = None if attachment is None else decode(attachment.to_bytes())
        if info is None:
            self.counters.add("refused")
            return
        missed = self._missed(info)
        if missed is None:  # an old frame, by which nothing is lost
            return
        if missed:
            self.counters.add("missed", missed)
        self._count_received()
        if skipped := self._latest.put((info, sample.payload)):
            self.counters.add("skipped", skipped)

    def _missed(self, info: FrameInfo) -> int | None:
        """Note a frame as the newest one; return how many were lost before it. None if it is an old one."""
        writer, number = self._newest
        if info.writer == self._replaced:
            return None
        if info.writer == writer and info.sequence <= number:
            return None  # sent as bytes, overtaken by a shared one: it was counted as missed
        if info.writer != writer:
            self._replaced = writer
        self._newest = info.writer, info.sequence
        return info.sequence - number - 1 if info.writer == writer else 0

    def _on_writer(self, sample: zenoh.Sample) -> None:
        """Note that a writer begins or ends; let the session be reopened to begin or to stop sharing memory with it."""
        try:
            writer_id, size, segment = self._names.writer_of(str(sample.key_expr))
        except ValueError:
            self.counters.add("refused")
            return
        if sample.kind != zenoh.SampleKind.PUT:
            self.running.discard(writer_id)
            return
        new = writer_id not in self._seen
        if new:
            self._seen.add(writer_id)
            self.counters.add("writers")
        self.running.add(writer_id)
        if new and size and self._lacked_room:  # this writer shares memory, so it has found room: so may the reader
            self._lacked_room = False
            self._reopen_soon("")
        if size and self.shared and (problem := self._why_not_map(size, segment)):
            self._reopen_soon(problem)

    def _why_not_map(self, size: int, segment: str) -> str:
        """Return why a writer's segment of ``size`` bytes must not be mapped; "" if it may be."""
        mappings = memory.mappings()
        if any(file.endswith(segment) for _, _, file in mappings):
            return ""  # it is mapped already: only the connection was lost
        total = sum(end - start for start, end, _ in mappings)
        if total > MAPPED_LIMIT:
            return (
                f"writers of {self._names.stream} were restarted so often that {total >> 20} MiB of their memory are "
                "lost until this process is restarted: from now on it gets frames as bytes"
            )
        needed = size + METADATA
        return "" if shared_memory.lockable(needed) else self._memlock_problem(needed)

    def _reopen_soon(self, problem: str) -> None:
        """Let the next `read` reopen the session, as Zenoh's thread cannot; with a ``problem``, without sharing."""
        self.problem = problem
        self._must_reopen.set()
        self._latest.wake()

    def _reopen(self) -> None:
        with self._changing:
            self._must_reopen.clear()
            if self._latest.closed:
                return
            self.counters.add("reopened")
            self._stop()
            self._start()

    def _memlock_problem(self, size: int) -> str:
        return shared_memory.memlock_problem(size, f"a reader of {self._names.stream}")


_Arrival = tuple[FrameInfo, zenoh.ZBytes]


class _LatestFrames:
    """A bounded queue of the newest frames, in order, from any thread to one thread."""

    def __init__(self, depth: int) -> None:
        self._depth = depth
        self.reopen()
        self.closed = True

    def reopen(self) -> None:
        self.closed = False
        self._items: deque[_Arrival | None] = deque()  # None only wakes the reading thread
        self._wakeup = Wakeup()

    def put(self, arrival: _Arrival) -> int:
        """Add a frame; return how many older frames were dropped for it."""
        items, dropped = self._items, 0
        items.append(arrival)
        while len(items) > self._depth:
            try:
                if items.popleft() is not None:  # None is no frame: :meth:`wake` adds it
                    dropped += 1
            except IndexError:  # taken in that moment
                break
        self._wakeup.set()
        return dropped

    def take(self, end: float | None) -> _Arrival | None:
        """Return the oldest frame; None at the time ``end`` (monotonic seconds) or when woken."""
        items, wakeup = self._items, self._wakeup
        while True:
            try:
                return items.popleft()  # None: :meth:`wake` or :meth:`close` was called
            except IndexError:
                if not wakeup.wait(end):  # the time has come
                    return None

    def wake(self) -> None:
        if not self._items:  # else it is awake already
            self._items.append(None)
            self._wakeup.set()

    def close(self) -> None:
        """Drop waiting frames: they pin the writer's memory."""
        self.closed = True
        self._items.clear()
        self._items.append(None)
        self._wakeup.set()


def _copy(data: bytes) -> Bytes:
    return np.frombuffer(data, np.uint8).copy()
