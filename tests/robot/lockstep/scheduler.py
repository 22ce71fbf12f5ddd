"""Virtual time: what is due happens in order, at once, on one thread."""

from __future__ import annotations

import heapq
from collections.abc import Callable
from itertools import count

from tests.kit.schedules import ViolatedError


class Scheduler:
    """Jobs by the time at which they are due; two of one time run in the order in which they were added."""

    def __init__(self, now: float) -> None:
        self.now = now
        self._heap: list[tuple[float, int, Callable[[], None]]] = []
        self._order = count()
        self._violated = ""

    def clock(self) -> float:
        return self.now

    def at(self, due: float, job: Callable[[], None]) -> None:
        heapq.heappush(self._heap, (max(due, self.now), next(self._order), job))

    def after(self, seconds: float, job: Callable[[], None]) -> None:
        self.at(self.now + seconds, job)

    def run(self, seconds: float) -> None:
        """Let time pass."""
        end = self.now + seconds
        while self._heap and self._heap[0][0] <= end:
            self.now, _, job = heapq.heappop(self._heap)
            job()
            if self._violated:
                raise ViolatedError(self._violated)
        self.now = end

    def check(self, holds: bool, rule: str) -> None:
        """A rule: if it does not hold, that ends the run, whatever is called in between."""
        if not holds:
            self._violated = self._violated or rule
            raise ViolatedError(self._violated)
