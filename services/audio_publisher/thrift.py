"""What is saved when the link is slow: first headers, then bits. Pure: the clock is passed in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from pebble.media.opus import BUNDLE_LIMIT

LEAST_BITRATE: Final = 16_000  # of Opus: below it speech gets hard to follow
_SLOW_S = 0.12  # packets wait for longer than this: the link cannot carry what we send
_FAST_S = 0.08  # a confirmation may be held back for 40 ms and is noticed only 20 ms later: less says nothing
_EMPTY_S = 0.03  # nothing waits
_HELD_S = 0.15  # so often at least where an access point holds confirmations until its next beacon (102.4 ms as a rule)
_PATIENCE_S = 0.3  # of slowness, before something is done
_PAUSE_S = 0.4  # before more is done: what waits already takes longer to leave, and commands wait behind it
_FIRST_CALM_S = 1.0  # of fastness, before a step up is tried while the link has never been slow
_CALM_S = 10.0  # the same once it was; twice that after each try that failed
_CALMEST_S = 300.0
_GAP_S = 2.0  # without a look, for want of a connection or of Opus: what was seen before says nothing


@dataclass(frozen=True, slots=True)
class Step:
    """What Opus is to be made like; ``told`` is for people."""

    bundle: int
    bitrate: int
    told: str = ""


def steps(bundle: int, bitrate: int) -> tuple[Step, ...]:
    """From as configured to as little as still makes sense; only steps that save something."""
    found = [Step(bundle, bitrate)]
    if bundle < BUNDLE_LIMIT:
        found.append(Step(BUNDLE_LIMIT, bitrate, f"{BUNDLE_LIMIT} parts a packet"))
    if bitrate > LEAST_BITRATE:
        told = f"{BUNDLE_LIMIT} parts a packet, {LEAST_BITRATE // 1000} kbit/s"
        found.append(Step(BUNDLE_LIMIT, LEAST_BITRATE, told))
    return tuple(found)


class Thrift:
    """Begins with the last step, for nobody knows the link yet. Goes up while packets do not wait, ever more carefully,
    and down while they do.
    """

    def __init__(self, last: int, now: float) -> None:
        self.level = self._last = last  # which step; 0 is as configured
        self._slow_since: float | None = None
        self._fast_since: float | None = None
        self._looked_at = self._empty_at = float("-inf")
        self._changed_at = now
        self._raised_at = float("-inf")
        self._calm_s = _FIRST_CALM_S

    def look(self, age_s: float, now: float) -> bool:
        """The oldest packet has waited for ``age_s``; True if the level changes."""
        if now - self._looked_at > _GAP_S:
            self._slow_since = self._fast_since = None
        self._looked_at = now
        self._slow_since = (self._slow_since or now) if age_s > _SLOW_S else None
        self._empty_at = now if age_s < _EMPTY_S else self._empty_at
        fast = age_s < _FAST_S or now - self._empty_at < _HELD_S
        self._fast_since = (self._fast_since or now) if fast else None
        if now - self._changed_at < _PAUSE_S:
            return False
        if self._slow_since is not None and now - self._slow_since >= _PATIENCE_S and self.level < self._last:
            failed = now - self._raised_at < 2 * self._calm_s
            self._calm_s = min(max(_CALM_S, (1 + failed) * self._calm_s), _CALMEST_S)
            return self._change(1, now)
        if self.level and self._fast_since is not None and now - max(self._fast_since, self._changed_at) > self._calm_s:
            self._raised_at = now
            return self._change(-1, now)
        return False

    def _change(self, by: int, now: float) -> bool:
        self.level, self._changed_at = self.level + by, now
        return True
