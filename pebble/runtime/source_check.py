"""Checks of a punctual source: it must not repeat itself, nor come at another rate. Pure."""

from collections import deque
from collections.abc import Hashable
from typing import Final

REPEATS_S: Final = 5.0  # of the same content: what is measured is never the same twice for so long
_RATE_S = 5.0  # over which a rate is measured
_SETTLE_S = 2.0  # from the first content on, in which it is not
_TOLERANCE = 0.2  # of the rate that was asked


class SourceCheck:
    """The record of what a source gave last, for how long, and how often. One thread writes, any reads."""

    def __init__(self, asked_hz: float = 0.0, *, remembered: int = 1) -> None:
        """``asked_hz``: 0 where every rate is right; ``remembered``: contents that are none if they come again."""
        self.content: Hashable = None  # the newest
        self.same_s = 0.0  # for how long nothing new has come
        self.changes = 0  # how often something new has
        self.alternates = False  # what comes again are several contents in turn
        self.wrong_hz: float | None = None  # the measured rate, if it is not what was asked
        self._asked_hz = asked_hz
        self._recent: deque[Hashable] = deque(maxlen=remembered)
        self._at = 0.0
        self._window: float | None = None  # when the measurement began, or will
        self._count = 0  # in it; -1: it has not begun

    @property
    def repeats(self) -> bool:
        return self.same_s >= REPEATS_S

    def clear(self) -> None:
        """Begin anew: the source was opened."""
        self.same_s, self.changes, self.wrong_hz, self._window = 0.0, 0, None, None
        self._recent.clear()

    def take(self, content: Hashable, now: float, *, counts: bool = True) -> None:
        """Note what has come. ``counts`` is False while it may be the same, as of a sensor at rest."""
        if content not in self._recent:
            self.changes += bool(self._recent)
            self._recent.append(content)
            self.same_s = 0.0
        else:
            self.same_s += (now - self._at) * counts
            self.alternates = content != self.content
        self.content, self._at = content, now

    def count(self, times: int, now: float) -> None:
        """Note that so many have come since the last call."""
        if self._window is None:
            self._window, self._count = now + _SETTLE_S, -1
        if now < self._window:
            return
        if self._count < 0:
            self._window, self._count = now, 0
            return
        self._count += times
        seconds = now - self._window
        if seconds >= _RATE_S:
            rate, asked = self._count / seconds, self._asked_hz
            off = abs(rate - asked) > max(_TOLERANCE * asked, 1 / seconds)
            self.wrong_hz = rate if asked and off else None
            self._window, self._count = now, 0
