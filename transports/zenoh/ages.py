"""How old a live message is when it arrives, whatever machine it comes from (T19).

Processes that share a boot share a clock that counts since that boot. Of another machine only this is known: its
fastest recent message took almost no time, so a message that took longer has waited somewhere.
"""

import threading
from dataclasses import dataclass

_MAX_CLOCKS = 64  # machines remembered; beyond them the oldest entry is dropped
_DRIFT = 1e-3  # two clocks drift apart by less, seconds per second
_WRONG_CLOCK_S = 5.0  # late for so long without a gap: the other clock was stopped, as in a paused virtual machine
_LATE_GAP_S = 1.0


@dataclass(slots=True)
class _Clock:
    """``least_difference``: our clock minus theirs, at its smallest. All in seconds."""

    least_difference: float
    received_at: float
    late_since: float | None = None
    late_at: float = 0.0


class MessageAges:
    """Computes the ages of messages, on Zenoh's receiving threads; one older than ``late_s`` is late."""

    def __init__(self, boot: int, late_s: float) -> None:
        self._boot, self.late_s = boot, late_s
        self._lock = threading.Lock()
        self._clocks: dict[int, _Clock] = {}

    def __len__(self) -> int:
        """How many machines are remembered."""
        return len(self._clocks)

    def age_s(self, boot: int, sent: float, now: float) -> float:
        """Both times in seconds, each since its own machine's boot. The first message of a machine counts as fresh."""
        if boot == self._boot:
            return now - sent
        with self._lock:
            clock = self._clocks.get(boot)
            if clock is None:
                clock = self._add(boot, now - sent, now)
            clock.least_difference = min(now - sent, clock.least_difference + _DRIFT * (now - clock.received_at))
            clock.received_at = now
            return self._assess(clock, now - sent, now)

    def _add(self, boot: int, difference: float, now: float) -> _Clock:
        if len(self._clocks) >= _MAX_CLOCKS:
            del self._clocks[next(iter(self._clocks))]
        clock = self._clocks[boot] = _Clock(difference, now)
        return clock

    def _assess(self, clock: _Clock, difference: float, now: float) -> float:
        """Messages queued while we were stopped come all at once; if messages stay late, the other clock is wrong."""
        if difference - clock.least_difference <= self.late_s:
            clock.late_since = None
            return difference - clock.least_difference
        if clock.late_since is None or now - clock.late_at > _LATE_GAP_S:
            clock.late_since = now
        clock.late_at = now
        if now - clock.late_since > _WRONG_CLOCK_S:
            clock.least_difference, clock.late_since = difference, None
        return difference - clock.least_difference
