"""How much of a picture a slow link gets: first less quality, then less size, then fewer frames. Pure: a clock is
passed in.

What counts is how long the link was busy with each frame, compared with the time between two frames. Nothing is ever
measured by sending more than is wanted.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from fractions import Fraction

from pebble.services.camera_publisher.send_queue import Passed

_FULL = 0.85  # share of the time the link may be busy before something is given up
_AIM = 0.6  # share it should be busy afterwards, and may be once something is taken back
_LOST = 0.05  # frames lost for each that was sent; more means that the link is full, however short its times
_STUCK_S = 0.5  # a frame that takes longer is answered at once
_WINDOW_S = 3.0  # frames that are looked at; long enough for a full picture among the changes
_SETTLED_S = 1.0  # before one looks at an average again
_PATIENCE_S, _LONGEST_PATIENCE_S = 4.0, 60.0  # of good times before something is taken back
_PROBATION_S = 10.0  # something that was taken back too early shows by then


@dataclass(frozen=True, slots=True)
class Step:
    """What is sent, as shares of what is wanted."""

    quality: Fraction
    size: Fraction  # of width and of height
    rate: Fraction
    bytes: float  # of one picture, roughly

    @property
    def cost(self) -> float:
        """Share of the bytes per second. Fewer frames differ more from each other."""
        return self.bytes * math.pow(self.rate, 0.9)

    def __str__(self) -> str:
        """What is reduced, for people: "quality 1/2, size 3/4"; empty if nothing is."""
        parts = {"quality": self.quality, "size": self.size, "rate": self.rate}
        return ", ".join(f"{name} {share}" for name, share in parts.items() if share != 1)


def _step(quality: str, size: str, rate: str) -> Step:
    """Costs as JPEG has them: half the quality is two thirds of the bytes, and small pictures are denser."""
    q, s, r = Fraction(quality), Fraction(size), Fraction(rate)
    return Step(q, s, r, math.pow(q, 0.6) * math.pow(s, 1.6))


#: From everything to hardly anything.
STEPS = (
    _step("1", "1", "1"),
    _step("3/4", "1", "1"),
    _step("1/2", "1", "1"),
    _step("1/2", "3/4", "1"),
    _step("1/2", "1/2", "1"),
    _step("1/2", "3/8", "1"),
    _step("1/2", "1/4", "1"),
    _step("1/2", "1/4", "2/3"),
    _step("1/2", "1/4", "1/2"),
    _step("1/2", "1/4", "1/4"),
    _step("1/2", "1/4", "1/8"),
)


class Adapter:
    """Down at once and as far as it takes, up one step at a time, and ever more patiently where that went wrong."""

    def __init__(self, fps: float, now: float) -> None:
        self.level = 0
        self._period = 1.0 / fps
        self._seen: deque[tuple[float, float]] = deque()  # when a frame had passed, and how long it took
        self._lost: deque[tuple[float, float]] = deque()  # when turns were lost, and how many
        self._changed_at = self._good_since = now
        self._rose_at: float | None = None  # None: nothing was taken back since the last step down
        self._patience = _PATIENCE_S

    @property
    def step(self) -> Step:
        return STEPS[self.level]

    def lose(self, turns: float, now: float) -> None:
        """So many frames could not be sent just now because those before them were late."""
        if now - (turns + 1) * self._frame_s > self._changed_at:  # else those before them were of another step
            self._lost.append((now, turns))

    def look(self, passed: list[Passed], age_s: float, now: float) -> bool:
        """Frames have ``passed``, the oldest that has not is ``age_s`` old. True: another step from now on."""
        self._seen.extend((now, frame.took_s) for frame in passed if frame.sent_at >= self._changed_at)
        for memory in (self._seen, self._lost):
            while memory and now - memory[0][0] > _WINDOW_S:
                memory.popleft()
        stuck_s = age_s if age_s <= now - self._changed_at else 0.0  # sent since the last change
        if stuck_s > _STUCK_S:
            return self._go_down(max(stuck_s / self._frame_s, self._load), now)
        if now - self._changed_at < _SETTLED_S or not self._seen:
            self._good_since = now
            return False
        load = self._load
        if load > _FULL:
            return self._go_down(load, now)
        if self.level == 0 or load * STEPS[self.level - 1].cost / self.step.cost > _AIM:
            self._good_since = now
        elif now - self._good_since >= self._patience:
            return self._go_up(now)
        return False

    @property
    def _frame_s(self) -> float:
        """Seconds from one frame to the next at this step."""
        return self._period / float(self.step.rate)

    @property
    def _load(self) -> float:
        """Share of the time the link is busy, if every frame that is due is sent: may well be above 1."""
        if not self._seen:
            return 0.0
        frames = len(self._seen)
        busy = sum(took for _, took in self._seen) / frames / self._frame_s
        lost = sum(turns for _, turns in self._lost) / frames
        return max(busy, 1.0 + lost) if lost > _LOST else busy

    def _go_down(self, load: float, now: float) -> bool:
        """As far as it takes; what was just taken back is merely given up again, and missed for longer."""
        lower = range(self.level + 1, len(STEPS))
        affordable = self.step.cost * _AIM / load
        if self._rose_at is not None and now - self._rose_at < _PROBATION_S:
            self._patience = min(_LONGEST_PATIENCE_S, 2 * self._patience)
            affordable = self.step.cost if load <= 2 * _FULL else affordable
        self._rose_at = None
        level = next((level for level in lower if STEPS[level].cost <= affordable), len(STEPS) - 1)
        return self._change(level, now)

    def _go_up(self, now: float) -> bool:
        if self._rose_at is not None and now - self._rose_at > _PROBATION_S:
            self._patience = max(_PATIENCE_S, self._patience / 2)
        self._rose_at = now
        return self._change(self.level - 1, now)

    def _change(self, level: int, now: float) -> bool:
        changed = level != self.level
        self.level = level
        self._seen.clear()
        self._lost.clear()
        self._changed_at = self._good_since = now
        return changed
