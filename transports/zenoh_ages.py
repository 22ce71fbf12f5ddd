"""How old a live message is when it arrives, whatever machine it comes from (T19).

Clocks that count since a boot can be compared by those who share the boot. Of another machine only this is known: its
fastest message of late took next to no time, so what needed longer than that has waited somewhere.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass

_BOOTS = 64  # machines remembered; beyond them the one that was new first is forgotten
_DRIFT = 1e-3  # two clocks drift apart by less, seconds per second
_PATIENCE_S = 5.0  # late for so long without a break: the other clock has stood still, as in a paused virtual machine
_BREAK_S = 1.0


@dataclass(slots=True)
class _Clock:
    """``least``: our clock minus theirs, at its smallest. All in seconds."""

    least: float
    heard_at: float
    late_since: float | None = None
    late_at: float = 0.0


class Ages:
    """Asked on Zenoh's receiving threads; ``late_s`` is the age from which on a message counts as late."""

    def __init__(self, boot: int, late_s: float) -> None:
        self._boot, self._late_s = boot, late_s
        self._lock = threading.Lock()
        self._clocks: dict[int, _Clock] = {}

    def age_s(self, boot: int, sent: float, now: float) -> float:
        """Both times in seconds, each since its own machine's boot. The first message of a machine counts as fresh."""
        if boot == self._boot:
            return now - sent
        with self._lock:
            clock = self._clocks.get(boot)
            if clock is None:
                clock = self._meet(boot, now - sent, now)
            clock.least = min(now - sent, clock.least + _DRIFT * (now - clock.heard_at))
            clock.heard_at = now
            return self._judge(clock, now - sent, now)

    def _meet(self, boot: int, difference: float, now: float) -> _Clock:
        if len(self._clocks) >= _BOOTS:
            del self._clocks[next(iter(self._clocks))]
        clock = self._clocks[boot] = _Clock(difference, now)
        return clock

    def _judge(self, clock: _Clock, difference: float, now: float) -> float:
        """What piled up while we stood still comes at once; what goes on being late is told by a wrong clock."""
        if difference - clock.least <= self._late_s:
            clock.late_since = None
            return difference - clock.least
        if clock.late_since is None or now - clock.late_at > _BREAK_S:
            clock.late_since = now
        clock.late_at = now
        if now - clock.late_since > _PATIENCE_S:
            clock.least, clock.late_since = difference, None
        return difference - clock.least
