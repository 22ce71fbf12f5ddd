"""Counts how often a board on a serial line has started, by its messages and by the line itself. Pure."""

from collections import deque

_MINUTE_S = 60.0
_ONE_START_S = 2.0  # a board that starts may say so, set its clock back and be opened again: that is one start
_CLOCK_BITS, _LEAST_MS = 32, 1000  # of a board's clock; samples that overtake one another set it back by less


class Starts:
    """The starts of a board after its first one. ``now`` is a time of a monotonic clock."""

    def __init__(self) -> None:
        self._starts: deque[float] = deque(maxlen=1000)
        self._opened = 0  # the opening of the line at the last call; 0: there was none
        self._clock_opened = self._clock_ms = -1  # the newest reading of the board's clock, and in which opening

    def began(self, now: float) -> None:
        """Note that the board has started again."""
        if not self._starts or now - self._starts[-1] >= _ONE_START_S:
            self._starts.append(now)

    def sent(self, opened: int, mcu_ms: int, now: float) -> None:
        """Note the board's clock, which begins at 0 with each start. A clock that goes back shows a start."""
        back_ms = (self._clock_ms - mcu_ms) % (1 << _CLOCK_BITS)  # a clock that goes on is "back" by more than half
        is_back = min(_LEAST_MS, mcu_ms + 1) <= back_ms < 1 << (_CLOCK_BITS - 1)  # by much, or nearly to 0
        if opened == self._clock_opened and is_back:
            self.began(now)
        self._clock_opened, self._clock_ms = opened, mcu_ms

    def within_a_minute(self, opened: int, now: float) -> int:
        """Return the number of starts in the last minute, including openings of the line except the first."""
        if opened != self._opened:
            if self._opened:
                self.began(now)
            self._opened = opened
        while self._starts and now - self._starts[0] > _MINUTE_S:
            self._starts.popleft()
        return len(self._starts)
