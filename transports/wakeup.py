"""An event that wakes the one thread waiting for new work."""

import threading
import time


class Wakeup:
    """An event that resets itself: any thread or signal handler sets it, one thread waits; a set before a wait counts.

    It is a bare lock that is free while the event is set. A Condition takes ten times as long, and a signal handler
    that notifies it may interrupt its own thread inside. ``queue.SimpleQueue.get(timeout=…)`` can wait for ever: if the
    timeout ends between two of its checks, the remainder is negative, which its lock takes for no timeout at all
    (Python 3.11: within a second, with timeouts of some µs, as a timer that is nearly due has them).
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._lock.acquire()

    def set(self) -> None:
        """Wake the waiting thread, now or in its next wait."""
        try:
            self._lock.release()
        except RuntimeError:  # set already
            return

    def wait(self, end: float | None) -> bool:
        """Wait until it is set or ``end`` (monotonic seconds) is reached; reset it and return whether it was set."""
        return self._lock.acquire(timeout=-1 if end is None else max(0.0, end - time.monotonic()))
