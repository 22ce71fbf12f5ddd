"""The bounded queue of a service, in which a newer job can replace a waiting one of the same name."""

import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable
from itertools import count

from pebble.transports.wakeup import Wakeup

Job = Callable[[], None]

LIMIT = 1000  # jobs that wait


class Inbox:
    """Jobs posted by any thread, taken by one. Beyond ``limit`` waiting jobs the oldest is dropped and counted.

    One that has a name is not dropped as long as there are others: no number of these keeps out the end of something.

    A signal handler may post while its own thread is inside any of these methods: the lock is reentrant, and so is the
    wakeup.
    """

    def __init__(self, limit: int = LIMIT) -> None:
        self._limit = limit
        self._lock = threading.RLock()
        self._wakeup = Wakeup()
        self._jobs: OrderedDict[Hashable, Job] = OrderedDict()
        self._internal: deque[Job] = deque()
        self._numbers = count()
        self._woken = False
        self.dropped = 0

    def post(self, job: Job, *, newest_of: Hashable = None, last_of: Hashable = None) -> None:
        """Queue ``job``; with ``newest_of`` it takes the place of a waiting job of the same name.

        With ``last_of`` it replaces that, too, but comes after all that wait.
        """
        with self._lock:
            if last_of is not None:
                self._jobs.pop(last_of, None)
            name = newest_of if last_of is None else last_of
            if len(self._jobs) >= self._limit and name not in self._jobs:
                del self._jobs[next((one for one in self._jobs if type(one) is int), next(iter(self._jobs)))]
                self.dropped += 1
            self._jobs[next(self._numbers) if name is None else name] = job
        self._wakeup.set()

    def post_internal(self, job: Job) -> None:
        """Queue a job of the service's own life cycle: first in line and never dropped."""
        self._internal.append(job)
        self._wakeup.set()

    def wake(self) -> None:
        """Make `wait` return, without a job."""
        self._woken = True
        self._wakeup.set()

    def wait(self, timeout: float | None) -> None:
        """Wait until there is a job, up to ``timeout`` seconds, or until `wake`."""
        if self:
            return
        end = None if timeout is None else time.monotonic() + timeout
        while not (self or self._woken):
            if not self._wakeup.wait(end):
                return
        self._woken = False

    def __bool__(self) -> bool:
        return bool(self._internal or self._jobs)

    def take(self, timeout: float | None = 0.0) -> Job | None:
        """Return the next job, waiting up to ``timeout`` seconds for one; None when there was none, or on `wake`."""
        if timeout != 0.0:
            self.wait(timeout)
        if self._internal:
            return self._internal.popleft()
        with self._lock:
            return self._jobs.popitem(last=False)[1] if self._jobs else None
