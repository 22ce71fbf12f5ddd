"""Arithmetic on the milliseconds of time.ticks_ms(), which start again after 2**30. Pure.

The same as time.ticks_diff and time.ticks_add of every MicroPython port; here so that cores need no clock module.
All steps stay within 31-bit integers, which MicroPython keeps without memory of their own.
"""

from micropython import const

_MASK = const((1 << 30) - 1)
_HALF = const(1 << 29)


def diff(later: int, earlier: int) -> int:
    """Milliseconds from ``earlier`` to ``later``; right while they are less than 6.2 days apart."""
    ahead = (later - earlier) & _MASK
    return ahead if ahead < _HALF else ahead - _HALF - _HALF


def add(moment: int, ms: int) -> int:
    """The moment ``ms`` after ``moment``."""
    return (moment + ms) & _MASK


class Grid:
    """Moments at a fixed distance: what a pause missed is not made up for, and being late once delays nothing later.

    ``due`` says True once per ``period``, for the first time one period after ``now``.
    """

    def __init__(self, period: int, now: int) -> None:
        self._period = period
        self._next = add(now, period)

    def due(self, now: int) -> bool:
        late = diff(now, self._next)
        if late < 0:
            return False
        self._next = add(self._next, (late // self._period + 1) * self._period)
        return True
