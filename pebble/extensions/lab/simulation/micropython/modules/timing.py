"""The ``time`` module of a simulated board."""

import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Final

from pebble.extensions.lab.simulation.micropython.clock import Clock

PERIOD: Final = 1 << 30  # of the ticks, on all ports with small integers of 31 bits
_HALF: Final = PERIOD >> 1
_MASK: Final = PERIOD - 1
_YEAR_2000_S: Final = 946_684_800
_ROUNDING: Final = 1e-6  # ms: 0.57 s are 569.9999999999999 ms


class BoardTime:
    """The module ``time``: ticks since boot on ``clock``. They begin at ``ticks_at_boot_ms``: tests choose the wrap."""

    def __init__(self, clock: Clock, pause: Callable[[float], None], ticks_at_boot_ms: int = 0) -> None:
        self._clock, self._pause = clock, pause
        self._ticks_at_boot = ticks_at_boot_ms
        self.booted = clock.now()

    def restart(self) -> None:
        self.booted = self._clock.now()

    def ticks_ms(self) -> int:
        passed = int((self._clock.now() - self.booted) * 1000 + _ROUNDING)
        return (self._ticks_at_boot + passed) & _MASK

    def time_ns(self) -> int:
        return int((self._clock.now() - self.booted) * 1_000_000_000)

    def module(self) -> SimpleNamespace:
        return SimpleNamespace(
            ticks_ms=self.ticks_ms,
            ticks_add=ticks_add,
            ticks_diff=ticks_diff,
            sleep=self._pause,
            sleep_ms=lambda ms: self._pause(ms / 1000),
            gmtime=gmtime,
            time_ns=self.time_ns,
        )


def gmtime(seconds: int) -> tuple[int, ...]:
    """Return (year, month, day, hour, minute, second, weekday, day of the year); counted from 2000, as on ESP32."""
    return tuple(time.gmtime(seconds + _YEAR_2000_S))[:8]


def ticks_add(ticks: int, delta: int) -> int:
    if not -_HALF < delta < _HALF:
        raise OverflowError("ticks interval overflow")
    return (ticks + delta) & _MASK


def ticks_diff(end: int, start: int) -> int:
    """Return the ticks from ``start`` to ``end``, -2**29..2**29-1."""
    return ((end - start + _HALF) & _MASK) - _HALF
