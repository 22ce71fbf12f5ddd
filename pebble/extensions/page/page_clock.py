"""Limits of the age of one page's messages, from pings that the page echoes. Pure: times are passed in.

The page's clock has an unknown offset. An echo carries the page's time at some moment between the sending of the ping
and the arrival of the echo, which limits the offset on both sides: so a constant delay counts as well.
"""

from collections import deque
from itertools import count

from pebble.errors import PebbleError
from pebble.extensions.operator.client.drive_reasons import LATE_S

PING_S = 0.5
_EXTRA_S = 0.3  # what a command may be older than the page's usual round trip
_ECHO_S = 1.0  # without an echo for so long nothing is known any more
_JUMP_S = 1.0
_ANSWERS = 20  # ten seconds of them: clocks drift apart by less than a millisecond
_UNANSWERED = 32
_JUDGED = 4  # answers by which people are told that a connection is slow


class ClockJumpError(PebbleError):
    """An error: the page's or the server's clock has jumped, as after a suspend. The page must connect again."""


class PageClock:
    """The clock of one connection. Times are seconds of the server's clock; ``t_ms`` is the page's."""

    def __init__(self) -> None:
        self.round_trip_s: float | None = None
        self._numbers = count(1)
        self._sent: dict[int, float] = {}
        self._echoed_at = float("-inf")
        self._bounds: deque[tuple[float, float, float]] = deque(maxlen=_ANSWERS)  # of the offset, and the round trip

    @property
    def shown_round_trip_s(self) -> float | None:
        """Return the second longest of the last four round trips, as one slow answer is no slow connection.

        If the last echo is late, its delay is returned instead.
        """
        if self.round_trip_s is None or self.round_trip_s >= LATE_S:
            return self.round_trip_s
        newest = sorted(round_trip for _, _, round_trip in list(self._bounds)[-_JUDGED:])
        return newest[-2:][0]

    def ping(self, now: float) -> int:
        if len(self._sent) >= _UNANSWERED:
            del self._sent[next(iter(self._sent))]
        number = next(self._numbers)
        self._sent[number] = now
        return number

    def echo(self, number: int, t_ms: float, now: float) -> None:
        """Handle the answer to a ping. The answer to a ping that was never sent is ignored. Raises ClockJumpError."""
        sent = self._sent.pop(number, None)
        if sent is None:
            return
        for older in [other for other in self._sent if other < number]:
            del self._sent[older]  # TCP keeps the order: these echoes will not come
        low, high = t_ms / 1000 - now, t_ms / 1000 - sent
        self._check(low, high)
        self.round_trip_s = now - sent
        self._bounds.append((low, high, now - sent))
        self._echoed_at = now

    def problem(self, now: float) -> str:
        """Return why commands of this page may move nothing now; empty if they may."""
        if now - self._echoed_at > _ECHO_S:
            return "the connection to the page is stalled"
        waiting = max((now - sent for sent in self._sent.values()), default=0.0)
        late = max(self.round_trip_s or 0.0, waiting)
        return f"commands are late ({1000 * late:.0f} ms)" if late >= LATE_S else ""

    def late(self, t_ms: float, now: float) -> bool:
        """True if a message stamped ``t_ms`` by the page may be too old to move anything. Raises ClockJumpError."""
        if not self._bounds:
            return True
        low = t_ms / 1000 - now
        self._check(low, float("inf"))
        age = now - t_ms / 1000 + self._highest()
        return age > min(LATE_S, min(round_trip for _, _, round_trip in self._bounds) + _EXTRA_S)

    def _highest(self) -> float:
        return min(high for _, high, _ in self._bounds)

    def _check(self, low: float, high: float) -> None:
        if self._bounds and (low > self._highest() + _JUMP_S or high < max(self._bounds)[0] - _JUMP_S):
            raise ClockJumpError("a clock has jumped: one of the two machines was suspended")
