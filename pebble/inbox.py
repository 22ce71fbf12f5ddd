"""The one queue a service works from: bounded, and able to keep only the newest of a kind."""

from __future__ import annotations

import queue
import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable
from itertools import count

Job = Callable[[], None]


class Inbox:
    """Jobs posted by any thread, taken by one. Beyond ``limit`` waiting jobs the oldest is dropped and counted.

    A signal handler may post while its own thread is inside any of these methods: the lock is reentrant, and a wake-up
    is an item of a queue, which waits for its taker where a notification would be lost.
    """

    def __init__(self, limit: int = 1000) -> None:
        self._limit = limit
        self._lock = threading.RLock()
        self._wakes: queue.SimpleQueue[None] = queue.SimpleQueue()  # one for each job
        self._jobs: OrderedDict[Hashable, Job] = OrderedDict()
        self._internal: deque[Job] = deque()
        self._numbers = count()
        self.dropped = 0

    def post(self, job: Job, *, newest_of: Hashable = None) -> None:
        """Queue ``job``; with ``newest_of`` it takes the place of a waiting job of the same name."""
        with self._lock:
            before = len(self._jobs)
            if before >= self._limit and newest_of not in self._jobs:
                self._jobs.popitem(last=False)
                self.dropped += 1
            self._jobs[next(self._numbers) if newest_of is None else newest_of] = job
            grown = len(self._jobs) > before
        if grown:  # else the wake-up of the job whose place this one took will do
            self._wakes.put(None)

    def post_internal(self, job: Job) -> None:
        """Queue a job of the service's own life cycle: first in line and never dropped."""
        self._internal.append(job)
        self._wakes.put(None)

    def take(self, timeout: float | None) -> Job | None:
        """The next job, waiting up to ``timeout`` seconds for one; None when there was none."""
        try:
            self._wakes.get(timeout=timeout)
        except queue.Empty:
            return None
        if self._internal:
            return self._internal.popleft()
        with self._lock:
            return self._jobs.popitem(last=False)[1] if self._jobs else None
