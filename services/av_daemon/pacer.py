"""Says when the next frame of a source without a device of its own is due: on the monotonic clock, without drift."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable


class Pacer:
    """Turn ``n`` is due at ``start + n / rate``, however long the ones before it took.

    Whoever is more than ``behind`` turns late skips to the present one. The wait ends early on :meth:`interrupt`.
    """

    def __init__(self, rate: float, *, behind: int = 0, start: float, clock: Callable[[], float] = time.monotonic):
        self._rate, self._behind, self._start, self._clock = rate, behind, start, clock
        self._turn = self._now()
        self.skipped = 0  # turns left out before the present one
        self._interrupted = threading.Event()

    def next(self) -> int:
        """Wait for the next turn; returns its number, counted from ``start``."""
        self._turn += 1
        late = self._now() - self._turn
        self.skipped = late if late > self._behind else 0
        self._turn += self.skipped
        self._interrupted.wait(max(0.0, self.due(self._turn) - self._clock()))
        return self._turn

    def due(self, turn: int) -> float:
        return self._start + turn / self._rate

    def interrupt(self) -> None:
        self._interrupted.set()

    @property
    def interrupted(self) -> bool:
        return self._interrupted.is_set()

    def _now(self) -> int:
        """The latest turn that is due."""
        return int((self._clock() - self._start) * self._rate)
