"""How long what was sent has been on its way, told from bytes alone. Pure: times and bytes are passed in."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

#: An acknowledgement may be held back for 40 ms by the other side's TCP: this much says nothing about the link.
SLACK_S = 0.05
#: An access point holds it back until its next beacon, every 102.4 ms as a rule, while the radio here saves power. Then
#: nor does this much; but only then, for on a slow link commands wait behind such pictures.
HELD_SLACK_S = 0.12
_HELD_S = 3.0  # for so long what was seen of that is believed
_PROBE_S = 2.0  # between two frames that are sent to see it
_PROMPT_S = 0.1  # beyond a round trip: a frame that took no longer met no other on its way
_MOST = 32  # frames under way at once; 30 per second need no more, with a second from here to there and back
_OVERHEAD = 64  # bytes of pings and headers that may be unconfirmed although the frame before them is


@dataclass(frozen=True, slots=True)
class Passed:
    """A frame the other machine has confirmed."""

    sent_at: float
    took_s: float  # how long it kept the link busy; short times are given the benefit of the doubt


class SendQueue:
    """The frames that one connection has accepted and the other side has not confirmed, oldest first.

    A connection confirms bytes in order. Of ``waiting`` unconfirmed ones the newest frame has up to its size, the one
    before it the next, and so on: what remains for no frame is confirmed.

    On a long way several frames travel at once: first one, then one more for each that came through promptly, because
    how much the way can hold shows only after a round trip.

    Confirmations that are held back come together: a late frame is confirmed at once with younger ones, which the link
    would have needed longer for, had it been slow. To tell, a younger frame has to be under way: when only one is, and
    late, another is let through now and then.
    """

    def __init__(self) -> None:
        self._frames: deque[tuple[int, float]] = deque()  # size, when it was sent
        self._limit = 1  # frames that may travel at once
        self._free_at = 0.0  # when the newest confirmed one was
        self._round_trip_s, self._looked_at = 0.0, float("-inf")  # at the last look
        self._held_until = self._probed_at = float("-inf")

    def __len__(self) -> int:
        return len(self._frames)

    def clear(self) -> None:
        """The connection is gone, with all that waited in it."""
        self._frames.clear()
        self._limit = 1

    def sent(self, size: int, now: float) -> None:
        if len(self._frames) == 1 and now - self._frames[0][1] - self._round_trip_s > SLACK_S:
            self._probed_at = now
        self._frames.append((size, now))

    def look(self, waiting: int, round_trip_s: float, now: float) -> list[Passed]:
        """The frames that are confirmed since the last look, while ``waiting`` bytes are not."""
        self._round_trip_s, since_s, self._looked_at = round_trip_s, now - self._looked_at, now
        passed, slack_s, sizes = [], self._slack_s(now), []
        newer = sum(size for size, _ in self._frames)
        while self._frames:
            size, sent_at = self._frames[0]
            newer -= size
            if waiting > newer + _OVERHEAD:
                break
            self._frames.popleft()
            began = max(sent_at + round_trip_s, self._free_at)
            self._free_at = now
            prompt = now - sent_at - round_trip_s <= _PROMPT_S
            self._limit = max(1, min(_MOST, self._limit + (1 if prompt else -1)))
            passed.append(Passed(sent_at, _credible(max(0.0, now - began), slack_s)))
            sizes.append(size)
        if len(passed) > 1:
            needed_s = since_s * sizes[0] / sum(sizes[1:])  # by the first frame, at the pace of those that came with it
            if now - passed[0].sent_at - round_trip_s > max(SLACK_S, 2 * needed_s):
                self._held_until = now + _HELD_S
        return passed

    def full(self, round_trip_s: float, now: float) -> bool:
        """Would another frame have to wait for those before it?"""
        if len(self._frames) >= self._limit:
            return True
        late_s = self.age_s(round_trip_s, now)
        probe = len(self._frames) == 1 and late_s <= HELD_SLACK_S - SLACK_S and now - self._probed_at >= _PROBE_S
        return late_s > 0 and not probe

    def age_s(self, round_trip_s: float, now: float) -> float:
        """How much longer than a mere round trip the oldest unconfirmed frame has waited; 0 without one."""
        if not self._frames:
            return 0.0
        return max(0.0, now - self._frames[0][1] - round_trip_s - self._slack_s(now))

    def _slack_s(self, now: float) -> float:
        """How late a confirmation may be and say nothing about the link."""
        return HELD_SLACK_S if now < self._held_until else SLACK_S


def _credible(took_s: float, slack_s: float) -> float:
    """How much of it is surely the link's: nothing of what an acknowledgement may be late, all of twice that."""
    return took_s * min(1.0, max(0.0, took_s / slack_s - 1.0))
