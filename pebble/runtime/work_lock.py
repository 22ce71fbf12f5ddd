"""The lock under which a service works: on its own thread, or on a thread that finds the service idle."""

import threading
from math import inf
from types import TracebackType


class WorkLock:
    """A lock for which only the service's own thread waits, by ``with``. Other threads try, and never wait.

    The service's thread waits for at most one other thread, because no third thread gets the lock before it.
    """

    def __init__(self) -> None:
        self.wakes_at = -inf  # when the service's thread runs timers next, on its clock; guarded by this lock
        self._lock = threading.Lock()
        self.awaited = False  # by the service's thread

    def __enter__(self) -> None:
        self.awaited = True
        self._lock.acquire()
        self.awaited = False

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._lock.release()

    def try_enter(self) -> bool:
        """Take the lock for another thread, which then calls `leave`. False while the service works."""
        return not self.awaited and self._lock.acquire(blocking=False)

    def leave(self) -> None:
        self._lock.release()

    def shut(self) -> None:
        """Take the lock for ever, for the service's own thread."""
        self.awaited = True
        self._lock.acquire()
