"""Clocks of a simulated board: the real one, or a virtual one that moves only when advanced."""

import time
from typing import Protocol


class Clock(Protocol):
    """Monotonic seconds. Every call that would block on a real board uses ``sleep``."""

    def now(self) -> float: ...

    def sleep(self, seconds: float) -> None: ...


class RealClock:
    """The real time: ``time.monotonic()``, with real sleeps."""

    def now(self) -> float:
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        time.sleep(max(0.0, seconds))


class VirtualClock:
    """A clock that moves only when advanced.

    Calls that block the firmware advance it, so that blocking shows in its deadlines.
    """

    def __init__(self, now: float = 0.0) -> None:
        self._now = now

    def now(self) -> float:
        return self._now

    def advance(self, seconds: float) -> None:
        """Advance by ``seconds``; time never goes back."""
        self._now += max(0.0, seconds)

    def until(self, moment: float) -> None:
        self._now = max(self._now, moment)

    def sleep(self, seconds: float) -> None:
        self.advance(seconds)
