"""Fred's speed limits: a trimmed left wheel, a slow reverse, and no reverse right after driving ahead. Pure."""

from micropython import const

from common.lines import clamp
from common.ticks import diff

_LEFT_TRIM = 0.93  # the right motor is the weaker one
_REVERSE_TRIM = 0.7
_BLOCK_MS = const(340)


class Gears:
    def __init__(self) -> None:
        self._ahead_at: int | None = None

    def limit(self, left: float, right: float, now: int) -> tuple[float, float]:
        """Return the motor speeds for wheel speeds -1..1. The robot can turn even while reverse is blocked."""
        linear, turn = (left + right) / 2, (left - right) / 2
        if linear > abs(turn):
            self._ahead_at = now
        elif linear < 0.0:
            # A difference less than 0: it drove ahead days ago, and the ticks have wrapped since.
            blocked = self._ahead_at is not None and 0 <= diff(now, self._ahead_at) < _BLOCK_MS
            linear = 0.0 if blocked else linear * _REVERSE_TRIM
        return clamp((linear + turn) * _LEFT_TRIM, -1.0), clamp(linear - turn, -1.0)
