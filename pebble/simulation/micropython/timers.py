"""Software timers of a simulated board: MicroPython calls them while the program waits for something."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pebble.simulation.micropython.clock import Clock


class SoftTimers:
    """``on_wait`` is called after each piece of a wait: whoever plays the host can type then, or end it all."""

    def __init__(self, clock: Clock) -> None:
        self.on_wait: Callable[[], None] = lambda: None
        self._clock = clock
        self._due: dict[Any, float] = {}
        self._busy = False

    @property
    def running(self) -> bool:
        return bool(self._due) and not self._busy

    def start(self, timer: Any) -> None:
        self._due[timer] = self._clock.now() + timer.period_s

    def stop(self, timer: Any) -> None:
        self._due.pop(timer, None)

    def clear(self) -> None:
        self._due.clear()
        self._busy = False

    def wait(self, longest_s: float) -> None:
        """Until the next timer has had its turn, at most ``longest_s``."""
        now = self._clock.now()
        left = min(self._due.values()) - now
        self._clock.sleep(max(0.0, min(left, longest_s)))
        if left <= longest_s:
            self._call()
        self.on_wait()

    def _call(self) -> None:
        self._busy = True
        try:
            now = self._clock.now()
            for timer in [timer for timer, due in self._due.items() if due <= now]:
                if timer.repeats:
                    self._due[timer] += timer.period_s
                else:
                    self.stop(timer)
                timer.callback(timer)
        finally:
            self._busy = False
