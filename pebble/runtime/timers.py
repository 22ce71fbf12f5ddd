"""Timers of a single thread, on the monotonic clock."""

import heapq
from collections.abc import Callable
from itertools import count
from math import inf

from msgspec import Struct


class Timer(Struct, eq=False):
    """A call that is due once, or periodically."""

    due: float
    job: Callable[[], None]
    period: float | None
    cancelled: bool = False

    def cancel(self) -> None:
        self.cancelled = True


class Timers:
    """A heap of timers. Its owner asks how long to wait, and then runs the due ones. Times are passed in."""

    def __init__(self) -> None:
        self._heap: list[tuple[float, int, Timer]] = []  # when each is due, a number that grows, and the timer
        self._order = count()

    def add(self, due: float, job: Callable[[], None], *, period: float | None = None) -> Timer:
        timer = Timer(due, job, period)
        heapq.heappush(self._heap, (due, next(self._order), timer))
        return timer

    @property
    def next_due(self) -> float:
        """Time of the next timer; infinite without timers."""
        heap = self._heap
        if heap and heap[0][2].cancelled:
            self._discard_cancelled()
        return heap[0][0] if heap else inf

    def run_due(self, now: float) -> None:
        """Run the due timers. A periodic timer that is late skips the runs that it has missed."""
        self._discard_cancelled()
        while self._heap and self._heap[0][0] <= now:
            timer = heapq.heappop(self._heap)[2]
            if timer.period is not None:
                timer.due += timer.period
                if timer.due <= now:
                    timer.due = now + timer.period
                heapq.heappush(self._heap, (timer.due, next(self._order), timer))
            timer.job()
            self._discard_cancelled()

    def _discard_cancelled(self) -> None:
        while self._heap and self._heap[0][2].cancelled:
            heapq.heappop(self._heap)
