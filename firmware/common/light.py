"""The state of a light: a steady colour, or a colour that fades in and out for ever. Pure."""

from micropython import const

from common.ticks import add, diff

_STEPS = const(512)  # of brightness: with the longest period a product still fits a small integer
_SHORTEST_MS = const(50)
_LONGEST_MS = const(3_600_000)


class Light:
    """A light. ``colour`` = (blue, green, red), each 0..1. ``period_ms``: one fade up and down; 0: steady."""

    def __init__(self, now: int) -> None:
        self.flash(0.0, 0.0, 1.0, 2.0, now)  # of Goob and Fred before the first command

    def glow(self, blue: float, green: float, red: float) -> None:
        self.colour = (blue, green, red)
        self.period_ms = 0

    def flash(self, blue: float, green: float, red: float, period_s: float, now: int) -> None:
        self.colour = (blue, green, red)
        self.period_ms = min(_LONGEST_MS, max(_SHORTEST_MS, int(min(period_s, 3600.0) * 1000 + 0.5)))
        self._began = now

    def level(self, now: int) -> int:
        """Return the brightness, 0..512."""
        if not self.period_ms:
            return _STEPS
        into = diff(now, self._began)
        if into >= self.period_ms:  # the start moves along, so that the ticks may wrap
            self._began = add(self._began, into // self.period_ms * self.period_ms)
            into %= self.period_ms
        half = self.period_ms // 2
        return min(into, self.period_ms - into) * _STEPS // half
