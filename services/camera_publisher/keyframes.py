"""When a full picture is sent because somebody asked for one. Pure: times are passed in."""

from __future__ import annotations

PERIOD_S = 1.0  # full pictures are large: whatever the number of those who ask, one per second


class Keyframes:
    """Requests that wait for their full picture. The one that is sent serves everybody who asked before it."""

    def __init__(self) -> None:
        self._asked = self._needed = False
        self._answered_at = float("-inf")

    def ask(self) -> None:
        """Somebody else has lost the thread."""
        self._asked = True

    def need(self) -> None:
        """We know that the next picture cannot build upon the last one."""
        self._needed = True

    def wanted(self, now: float) -> bool:
        """Is the next picture to be a full one?"""
        return self._needed or (self._asked and now - self._answered_at >= PERIOD_S)

    def sent(self, now: float) -> None:
        """A full picture is on its way, for whatever reason."""
        self._asked = self._needed = False
        self._answered_at = now
