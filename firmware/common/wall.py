"""Epoch milliseconds from one answer of a time server and the board's own ticks. Pure."""

from common.ticks import diff


class Wall:
    """Before the first ``set`` it tells milliseconds since it was made: a small number, which readers take as no time.

    ``read`` it at least once in six days: that is how far ticks reach.
    """

    def __init__(self, now: int) -> None:
        self._epoch_ms = 0
        self._at = now

    def set(self, epoch_ms: int, now: int) -> None:
        """It was ``epoch_ms`` at tick ``now``."""
        self._epoch_ms = epoch_ms
        self._at = now

    def read(self, now: int) -> int:
        self._epoch_ms += diff(now, self._at)
        self._at = now
        return self._epoch_ms
