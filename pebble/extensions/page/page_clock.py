"""Limits of the age of one page's messages, from pings that the page echoes. Pure: times are passed in.

The page's clock has an unknown offset. An echo carries the page's time at some moment between the sending of the ping
and the arrival of the echo, which limits the offset on both sides. A message counts as old as these limits allow, so
that no constant delay is overlooked.
"""

from collections import deque
from itertools import count
from typing import NamedTuple

from pebble.errors import PebbleError
from pebble.extensions.operator.client.drive_reasons import LATE_S

PING_S = 0.5
_EXTRA_S = 0.3  # so much older than the page's shortest round trip a command may be
_ECHO_S = 1.0  # without an echo for so long nothing is known any more
_JUMP_S = 1.0  # by so much a clock may contradict its limits, as it drifts and is set by NTP
_ANSWERS = 20  # echoes that are remembered, ten seconds of them: clocks drift apart by less than a millisecond
_UNANSWERED = 32  # pings that are remembered
_JUDGED = 4  # answers by which people are told that a connection is slow


class ClockJumpError(PebbleError):
    """An error: the page's or the server's clock has jumped, as after a suspend. The page must connect again."""


class _Answer(NamedTuple):
    """An echo: the limits of the offset of the page's clock (page minus server) that follow from it. Seconds."""

    lowest_offset_s: float
    highest_offset_s: float
    round_trip_s: float


class PageClock:
    """The clock of one connection. Times are seconds of the server's clock; ``t_ms`` is the page's."""

    def __init__(self) -> None:
        self.round_trip_s: float | None = None
        self._numbers = count(1)
        self._sent: dict[int, float] = {}  # when each unanswered ping was sent
        self._echoed_at = float("-inf")
        self._answers: deque[_Answer] = deque(maxlen=_ANSWERS)

    @property
    def shown_round_trip_s(self) -> float | None:
        """Return the second longest of the last four round trips, as one slow answer is no slow connection.

        If the last echo is late, its delay is returned instead.
        """
        if self.round_trip_s is None or self.round_trip_s >= LATE_S:
            return self.round_trip_s
        ordered = sorted(answer.round_trip_s for answer in list(self._answers)[-_JUDGED:])
        return ordered[-2] if len(ordered) > 1 else ordered[0]

    def ping(self, now: float) -> int:
        """Note that a ping is sent now; return its number."""
        if len(self._sent) >= _UNANSWERED:
            del self._sent[next(iter(self._sent))]
        number = next(self._numbers)
        self._sent[number] = now
        return number

    def echo(self, number: int, t_ms: float, now: float) -> None:
        """Handle the answer to a ping. The answer to a ping that was never sent is ignored. Raises ClockJumpError."""
        sent_at = self._sent.pop(number, None)
        if sent_at is None:
            return
        for older in [other for other in self._sent if other < number]:
            del self._sent[older]  # TCP keeps the order: these echoes will not come
        answer = _Answer(t_ms / 1000 - now, t_ms / 1000 - sent_at, now - sent_at)
        self._check(answer.lowest_offset_s, answer.highest_offset_s)
        self.round_trip_s = answer.round_trip_s
        self._answers.append(answer)
        self._echoed_at = now

    def problem(self, now: float) -> str:
        """Return why commands of this page may move nothing now; empty if they may."""
        if now - self._echoed_at > _ECHO_S:
            return "the connection to the page is stalled"
        unanswered_s = max((now - sent_at for sent_at in self._sent.values()), default=0.0)
        late_s = max(self.round_trip_s or 0.0, unanswered_s)
        return f"commands are late ({1000 * late_s:.0f} ms)" if late_s >= LATE_S else ""

    def late(self, t_ms: float, now: float) -> bool:
        """True if a message stamped ``t_ms`` by the page may be too old to move anything. Raises ClockJumpError."""
        if not self._answers:
            return True
        self._check(t_ms / 1000 - now, float("inf"))  # when it was sent is not known: no limit from above
        oldest_age_s = now - (t_ms / 1000 - self._highest_offset_s())
        usual_s = min(answer.round_trip_s for answer in self._answers)
        return oldest_age_s > min(LATE_S, usual_s + _EXTRA_S)

    def _highest_offset_s(self) -> float:
        return min(answer.highest_offset_s for answer in self._answers)

    def _check(self, lowest_offset_s: float, highest_offset_s: float) -> None:
        """Raise ClockJumpError if these limits of the offset contradict the earlier ones.

        They do if the lowest one is above the earlier highest one, or the highest one below the earlier lowest one.
        """
        if not self._answers:
            return
        earlier_lowest_s = max(answer.lowest_offset_s for answer in self._answers)
        too_high = lowest_offset_s > self._highest_offset_s() + _JUMP_S
        if too_high or highest_offset_s < earlier_lowest_s - _JUMP_S:
            raise ClockJumpError("a clock has jumped: one of the two machines was suspended")
