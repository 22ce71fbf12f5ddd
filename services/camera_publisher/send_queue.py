"""How long what was sent has been on its way, told from bytes alone. Pure: times and bytes are passed in."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

#: An acknowledgement may be held back for 40 ms by the other side's TCP: this much says nothing about the link.
SLACK_S = 0.05
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
    """

    def __init__(self) -> None:
        self._frames: deque[tuple[int, float]] = deque()  # size, when it was sent
        self._limit = 1  # frames that may travel at once
        self._free_at = 0.0  # when the newest confirmed one was

    def __len__(self) -> int:
        return len(self._frames)

    def clear(self) -> None:
        """The connection is gone, with all that waited in it."""
        self._frames.clear()
        self._limit = 1

    def sent(self, size: int, now: float) -> None:
        self._frames.append((size, now))

    def look(self, waiting: int, round_trip_s: float, now: float) -> list[Passed]:
        """The frames that are confirmed since the last look, while ``waiting`` bytes are not."""
        passed = []
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
            passed.append(Passed(sent_at, _credible(max(0.0, now - began))))
        return passed

    def full(self, round_trip_s: float, now: float) -> bool:
        """Would another frame have to wait for those before it?"""
        return len(self._frames) >= self._limit or self.age_s(round_trip_s, now) > 0

    def age_s(self, round_trip_s: float, now: float) -> float:
        """How much longer than a mere round trip the oldest unconfirmed frame has waited; 0 without one."""
        if not self._frames:
            return 0.0
        return max(0.0, now - self._frames[0][1] - round_trip_s - SLACK_S)


def _credible(took_s: float) -> float:
    """How much of it is surely the link's: nothing of what an acknowledgement may be late, all of twice that."""
    return took_s * min(1.0, max(0.0, took_s / SLACK_S - 1.0))
