"""The watchdog and the software timers of a simulated board."""

import math
from collections.abc import Callable
from typing import Any

from pebble.extensions.lab.simulation.micropython.clock import Clock


class BoardReset(BaseException):
    """A reset of the board. Firmware catches no BaseException; the runner does, and reboots the board."""


class Watchdog:
    """A watchdog: once armed, it resets the board unless it is fed in time."""

    def __init__(self, clock: Clock) -> None:
        self.feeds = 0
        self.timeout_ms: int | None = None
        self._clock = clock
        self._fed_at = 0.0

    def arm(self, timeout_ms: int) -> None:
        self.timeout_ms, self._fed_at = timeout_ms, self._clock.now()

    def disarm(self) -> None:
        """Stop the watchdog, which only a reset of the board does."""
        self.timeout_ms = None

    def feed(self) -> None:
        self.check()
        self.feeds += 1
        self._fed_at = self._clock.now()

    def left(self) -> float:
        """Return the seconds until the watchdog resets the board."""
        if self.timeout_ms is None:
            return math.inf
        return max(0.0, self._fed_at + self.timeout_ms / 1000 - self._clock.now())

    def starved(self, now: float) -> bool:
        """True if the watchdog would have reset the board by ``now``."""
        return self.timeout_ms is not None and now >= self._fed_at + self.timeout_ms / 1000

    def check(self) -> None:
        """Raise BoardReset if it was not fed in time."""
        if self.starved(self._clock.now()):
            raise BoardReset("the watchdog was not fed in time")


class SoftTimers:
    """Timers that run while the program waits. Tests may use ``on_wait``, called after each part of a wait."""

    def __init__(self, clock: Clock) -> None:
        self.on_wait: Callable[[], None] = lambda: None
        self._clock = clock
        self._due: dict[Any, float] = {}  # by timer
        self._busy = False  # a timer's function runs, which may wait as well

    @property
    def running(self) -> bool:
        return bool(self._due) and not self._busy

    def start(self, timer: Any) -> None:
        self._due[timer] = self._clock.now() + timer.period_s

    def clear(self) -> None:
        self._due.clear()
        self._busy = False

    def wait(self, longest_s: float) -> None:
        """Wait until the next timer has run, but at most ``longest_s``; only while timers are :attr:`running`."""
        now = self._clock.now()
        until_due_s = min(self._due.values()) - now
        self._clock.sleep(max(0.0, min(until_due_s, longest_s)))
        if until_due_s <= longest_s:
            self._call()
        self.on_wait()

    def _call(self) -> None:
        """Call the functions of the timers that are due; meanwhile none is :attr:`running`."""
        self._busy = True
        try:
            now = self._clock.now()
            for timer in [timer for timer, due in self._due.items() if due <= now]:
                self._due[timer] += timer.period_s
                timer.callback(timer)
        finally:
            self._busy = False
