"""What a simulated board takes for the time: the real one, or one that only moves when somebody moves it."""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    """Monotonic seconds. ``sleep`` is what every call does that would block on a real board."""

    def now(self) -> float: ...

    def sleep(self, seconds: float) -> None: ...


class RealClock:
    """``time.monotonic()``; sleeping takes as long as it says."""

    def now(self) -> float:
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        time.sleep(max(0.0, seconds))


class VirtualClock:
    """Stands still unless moved. Whatever blocks the firmware moves it, so that blocking shows in its deadlines."""

    def __init__(self, now: float = 0.0) -> None:
        self._now = now

    def now(self) -> float:
        return self._now

    def advance(self, seconds: float) -> None:
        """Let ``seconds`` pass; time never goes back."""
        self._now += max(0.0, seconds)

    def until(self, moment: float) -> None:
        """Let time pass until ``moment``, if that is not over yet."""
        self._now = max(self._now, moment)

    def sleep(self, seconds: float) -> None:
        self.advance(seconds)
