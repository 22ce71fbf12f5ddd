"""The bounded queue of a service. A newer job can replace a waiting job of the same name."""

import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable
from itertools import count

from pebble.transports.wakeup import Wakeup

Job = Callable[[], None]

LIMIT = 1000  # jobs that wait


class Inbox:
    """A queue of jobs, posted by any thread and taken by one. Beyond ``limit`` jobs the oldest is dropped and counted.

    Jobs without a name are dropped first, so that they cannot keep out a command that ends something.

    A signal handler may post while its own thread is inside any of these methods: the lock and the wakeup are
    reentrant.
    """

    def __init__(self, limit: int = LIMIT) -> None:
        self._limit = limit
        self._lock = threading.RLock()
        self._wakeup = Wakeup()
        self._jobs: OrderedDict[Hashable, Job] = OrderedDict()  # by name, or by a number if a job has none
        self._internal: deque[Job] = deque()  # of :meth:`post_internal`: first, and never dropped
        self._numbers = count()
        self._woken = False  # by :meth:`wake`, since the last wait
        self.dropped = 0

    def post(self, job: Job, *, newest_of: Hashable = None, last_of: Hashable = None) -> None:
        """Queue ``job``. With ``newest_of`` the job replaces a waiting job of that name, at its place in the queue.

        With ``last_of`` the job replaces such a job as well, but goes to the end of the queue.
        """
        with self._lock:
            if last_of is not None:
                self._jobs.pop(last_of, None)
            name = newest_of if last_of is None else last_of
            if len(self._jobs) >= self._limit and name not in self._jobs:
                oldest = next(iter(self._jobs))
                oldest_unnamed = next((key for key in self._jobs if type(key) is int), oldest)
                del self._jobs[oldest_unnamed]
                self.dropped += 1
            self._jobs[next(self._numbers) if name is None else name] = job
        self._wakeup.set()

    def post_internal(self, job: Job) -> None:
        """Queue a job of the service's life cycle, before all others. It is never dropped."""
        self._internal.append(job)
        self._wakeup.set()

    def wake(self) -> None:
        """Make `wait` return without a job."""
        self._woken = True
        self._wakeup.set()

    def wait(self, timeout: float | None) -> None:
        """Wait for a job or for `wake`, up to ``timeout`` seconds."""
        if self:
            return  # if it was woken as well, a later call returns for that
        end = None if timeout is None else time.monotonic() + timeout
        while not (self or self._woken):
            if not self._wakeup.wait(end):
                return
        self._woken = False

    def __bool__(self) -> bool:
        return bool(self._internal or self._jobs)

    def take(self, timeout: float | None = 0.0) -> Job | None:
        """Remove and return the next job, waiting up to ``timeout`` seconds; None if there was none, or on `wake`."""
        if timeout != 0.0:
            self.wait(timeout)
        if self._internal:  # only this thread takes, so that no lock is needed
            return self._internal.popleft()
        with self._lock:
            return self._jobs.popitem(last=False)[1] if self._jobs else None
