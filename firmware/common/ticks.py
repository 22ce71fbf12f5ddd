"""Arithmetic on the milliseconds of time.ticks_ms(), which wrap after 2**30. Pure.

The same as time.ticks_diff and time.ticks_add of every MicroPython port; here so that pure modules need no clock
module. All intermediate values are 31-bit integers, for which MicroPython allocates no memory.
"""

from micropython import const

_MASK = const((1 << 30) - 1)
_HALF = const(1 << 29)


def diff(now: int, since: int) -> int:
    """Return the milliseconds from ``since`` to ``now``; correct while they are less than 6.2 days apart."""
    ahead = (now - since) & _MASK
    return ahead if ahead < _HALF else ahead - _HALF - _HALF


def add(since: int, ms: int) -> int:
    """Return the time ``ms`` after ``since``."""
    return (since + ms) & _MASK


class Grid:
    """Times at a fixed period. Missed ones are skipped, and a late one does not delay the following ones.

    ``due`` returns True once per ``period``, first one period after ``now``.
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
