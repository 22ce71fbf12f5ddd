"""Bounds the work that one page can ask of the server: a page beyond it is read more slowly. Pure."""

from __future__ import annotations

PER_S = 100.0  # a page that drives sends 25 messages a second
BURST = 200.0


class Pace:
    """A bucket of ``burst`` that fills by ``per_s``."""

    def __init__(self, now: float, per_s: float = PER_S, burst: float = BURST) -> None:
        self._per_s, self._burst = per_s, burst
        self._left, self._at = burst, now

    def take(self, cost: float, now: float) -> float:
        """How many seconds to wait before this is done."""
        self._left = min(self._burst, self._left + self._per_s * (now - self._at)) - cost
        self._at = now
        return max(0.0, -self._left / self._per_s)

    def allows(self, now: float) -> bool:
        """Whether this may be done now; what may not costs nothing."""
        self._left, self._at = min(self._burst, self._left + self._per_s * (now - self._at)), now
        if self._left < 1:
            return False
        self._left -= 1
        return True
