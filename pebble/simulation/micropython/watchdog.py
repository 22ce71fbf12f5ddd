"""The watchdog of a simulated board, as seen from outside: how often and when it was fed."""

from __future__ import annotations

import math
from collections.abc import Callable

from pebble.simulation.micropython.clock import Clock


class BoardReset(BaseException):
    """The board resets, whatever the firmware catches; whoever runs it boots it anew."""


class Watchdog:
    """Nothing happens until it is armed; then it has to be fed. ``on_feed`` is called each time: once per turn."""

    def __init__(self, clock: Clock) -> None:
        self.feeds = 0
        self.on_feed: Callable[[], None] = lambda: None
        self.timeout_ms: int | None = None
        self._clock = clock
        self._fed_at = 0.0

    def arm(self, timeout_ms: int) -> None:
        self.timeout_ms, self._fed_at = timeout_ms, self._clock.now()

    def disarm(self) -> None:
        """What only a reset does."""
        self.timeout_ms = None

    def feed(self) -> None:
        self.check()
        self.feeds += 1
        self._fed_at = self._clock.now()
        self.on_feed()

    def left(self) -> float:
        """Seconds until it resets the board."""
        if self.timeout_ms is None:
            return math.inf
        return max(0.0, self._fed_at + self.timeout_ms / 1000 - self._clock.now())

    def starved(self, now: float) -> bool:
        """Whether it would have reset the board by ``now``."""
        return self.timeout_ms is not None and now >= self._fed_at + self.timeout_ms / 1000

    def check(self) -> None:
        """Reset the board if it was not fed in time."""
        if self.starved(self._clock.now()):
            raise BoardReset("the watchdog was not fed in time")
