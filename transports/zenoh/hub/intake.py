"""The bounded queue before a hub's thread, for tasks and queries from Zenoh's threads."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from time import monotonic

import zenoh

from pebble.transports.zenoh import wire
from pebble.transports.zenoh.hub.store import OVERHEAD

log = logging.getLogger(__name__)

QUEUE_BYTES = 2 << 20  # of tasks that wait, some 5,000; beyond it …
SENDERS = 8  # … their senders wait; more would take the threads that receive stops
QUERIES = 10_000  # that wait
ASKED_BYTES = 1 << 20  # of one hello or query

Task = Callable[[], None]
_OnQuery = Callable[[zenoh.Query], None]


class Intake:
    """Tasks and queries in the order of arrival, taken alternately, so that neither kind delays the other."""

    def __init__(self) -> None:
        self.dropped = 0  # tasks
        self._lock = threading.Lock()
        self._changed, self._room = threading.Condition(self._lock), threading.Condition(self._lock)
        self._tasks, self._queries = deque[tuple[Task, int]](), deque[Task]()
        self._bytes = 0  # of the tasks
        self._waiting_senders = 0  # for room
        self._was_task = False  # a task was taken last, so it is the queries' turn
        self._ended = False

    def put(self, task: Task) -> None:
        """Queue a task of the hub itself, or the arrival or departure of a client."""
        with self._lock:
            self._tasks.append((task, 0))
            self._changed.notify()

    def receive(self, task: Task, size: int) -> None:
        """Queue the task for a received message of ``size`` bytes. Wait for room; drop it if too many others wait."""
        size += OVERHEAD
        with self._lock:
            if self._waiting_senders or not self._has_room(size):
                if self._waiting_senders >= SENDERS:
                    self._note_dropped()
                    return
                self._waiting_senders += 1
                self._room.wait_for(lambda: self._has_room(size))
                self._waiting_senders -= 1
            self._tasks.append((task, size))
            self._bytes += size
            self._changed.notify()
            self._room.notify()  # the next sender that waits: there may be room for it as well

    def greet(self, work: _OnQuery, query: zenoh.Query) -> None:
        """Queue a hello or goodbye, which counts as a task."""
        if (size := _size(query)) <= ASKED_BYTES:
            self.receive(lambda: work(query), size)
        else:
            query.drop()  # type: ignore[no-untyped-call]

    def ask(self, work: _OnQuery, query: zenoh.Query) -> None:
        """Queue a query. It gets no answer if too many wait, or once its client no longer waits."""
        asked_at = monotonic()

        def answer() -> None:
            if monotonic() - asked_at < wire.RETAINED_ANSWER_S:
                work(query)
            else:
                query.drop()  # type: ignore[no-untyped-call]

        with self._lock:
            admitted = len(self._queries) < QUERIES and _size(query) <= ASKED_BYTES
            if admitted:
                self._queries.append(answer)
                self._changed.notify()
        if not admitted:
            query.drop()  # type: ignore[no-untyped-call]

    def end(self) -> None:
        """Make :meth:`take` return None once the queue is empty."""
        with self._lock:
            self._ended = True
            self._changed.notify()

    def take(self, timeout: float | None) -> Task | None:
        """Return the next task; after ``timeout`` seconds, a task that does nothing; None at the end."""
        with self._lock:
            if not (self._tasks or self._queries or self._ended) and not self._changed.wait(timeout):
                return _nothing
            if self._queries and (self._was_task or not self._tasks):  # it is their turn
                self._was_task = False
                return self._queries.popleft()
            if not self._tasks:
                return None if self._ended else _nothing
            self._was_task = True
            task, size = self._tasks.popleft()
            self._bytes -= size
            self._room.notify()
            return task

    def _has_room(self, size: int) -> bool:
        """True if ``size`` bytes fit. A task larger than the whole room fits if no other waits."""
        return not self._bytes or self._bytes + size <= QUEUE_BYTES

    def _note_dropped(self) -> None:
        self.dropped += 1
        if self.dropped & (self.dropped - 1) == 0:  # the 1st, 2nd, 4th, 8th…
            log.error("the hub receives more than it can store: %d messages dropped so far", self.dropped)


def _size(query: zenoh.Query) -> int:
    return 0 if query.payload is None else len(query.payload)


def _nothing() -> None:
    """Do nothing: this stands for a wait that has ended without a task."""
