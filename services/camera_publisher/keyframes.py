"""When a full picture is sent because one was requested or is required. Pure: times are passed in."""

from __future__ import annotations

PERIOD_S = 1.0  # full pictures are large: one per second, however many receivers request one


class KeyframeRequests:
    """The requests since the last full picture; the next one answers all of them."""

    def __init__(self) -> None:
        self._requested = self._required = False
        self._sent_at = float("-inf")

    def request(self) -> None:
        """A receiver cannot decode the differences."""
        self._requested = True

    def require(self) -> None:
        """The next picture cannot build upon the last one: send a full one at once."""
        self._required = True

    def due(self, now: float) -> bool:
        """Has the next picture to be a full one?"""
        return self._required or (self._requested and now - self._sent_at >= PERIOD_S)

    def sent(self, now: float) -> None:
        """A full picture was sent, for whatever reason."""
        self._requested = self._required = False
        self._sent_at = now
