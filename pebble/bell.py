"""Wakes up the one thread that waits for something new."""

from __future__ import annotations

import threading
import time


class Bell:
    """Rung by any thread, and by signal handlers at any moment; what rings before somebody waits is not lost.

    Made of a bare lock that is free while the bell rings. A Condition takes ten times as long, and a signal handler
    that notifies it may meet its own thread inside. ``queue.SimpleQueue.get(timeout=…)`` can wait for ever: where the
    timeout ends between two of its looks, what remains of it is negative, and its lock takes that for no timeout at
    all (Python 3.11: within a second, with timeouts of some µs, as a timer that is nearly due has them).
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._lock.acquire()

    def ring(self) -> None:
        try:
            self._lock.release()
        except RuntimeError:  # it rings already
            return

    def wait(self, end: float | None) -> bool:
        """Until it rings, at the latest until ``end`` (monotonic seconds): did it ring? It is silent then."""
        return self._lock.acquire(timeout=-1 if end is None else max(0.0, end - time.monotonic()))
