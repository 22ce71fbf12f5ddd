"""One thread that waits for file descriptors and timers at once."""

from __future__ import annotations

import selectors
import time
from collections.abc import Callable

from pebble.timers import Timer, Timers

Job = Callable[[], None]


class Reactor:
    """Calls jobs when a descriptor can be read or a time has come. For one thread only."""

    def __init__(self) -> None:
        self._selector = selectors.DefaultSelector()
        self._timers = Timers()

    def watch(self, descriptor: int, job: Job) -> None:
        """Call ``job`` whenever ``descriptor`` has something to read, until :meth:`forget`."""
        self._selector.register(descriptor, selectors.EVENT_READ, job)

    def forget(self, descriptor: int) -> None:
        self._selector.unregister(descriptor)

    def at(self, due: float, job: Job) -> Timer:
        """Call ``job`` at ``due`` on ``time.monotonic()``."""
        return self._timers.add(due, job)

    def after(self, seconds: float, job: Job) -> Timer:
        return self._timers.add(time.monotonic() + seconds, job)

    def every(self, seconds: float, job: Job) -> Timer:
        return self._timers.add(time.monotonic() + seconds, job, period=seconds)

    def run_until(self, condition: Callable[[], bool], timeout: float | None = None) -> bool:
        """Work until ``condition()`` holds; False when ``timeout`` seconds went by without it."""
        end = None if timeout is None else time.monotonic() + timeout
        while not condition():
            now = time.monotonic()
            if end is not None and now >= end:
                return False
            self._turn(self._timers.wait(now), None if end is None else end - now)
        return True

    def close(self) -> None:
        self._selector.close()

    def _turn(self, *waits: float | None) -> None:
        """What was said is heard before a timer judges the silence."""
        limited = [wait for wait in waits if wait is not None]
        for key, _ in self._selector.select(min(limited) if limited else None):
            if key.fd in self._selector.get_map():  # an earlier job of this turn may have let go of it
                key.data()
        self._timers.run_due(time.monotonic())
