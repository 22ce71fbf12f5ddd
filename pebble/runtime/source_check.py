"""Checks that a source sends at the right rate, and that its contents do not repeat themselves. Pure."""

from collections import deque
from collections.abc import Hashable
from typing import Final

REPEATS_S: Final = 5.0  # with the same content: measurements are never the same for so long
_RATE_S = 5.0  # over which a rate is measured
_SETTLE_S = 2.0  # after the first content, before it is measured
_TOLERANCE = 0.2  # of the rate that was asked


class SourceCheck:
    """A record of a source's newest contents and of its rate. One thread writes, any thread reads."""

    def __init__(self, asked_hz: float = 0.0, *, remembered: int = 1) -> None:
        """Make a record. ``asked_hz``: 0 for any rate; ``remembered``: how many recent contents to compare."""
        self.content: Hashable = None  # the newest
        self.same_s = 0.0  # for so long no new content has come
        self.changes = 0  # so often a new content has come
        self.alternates = False  # several remembered contents come in turn
        self.wrong_hz: float | None = None  # the measured rate, if another was asked for
        self._asked_hz = asked_hz
        self._recent: deque[Hashable] = deque(maxlen=remembered)
        self._at = 0.0  # when the newest came
        self._window: float | None = None  # when the measurement of the rate began, or begins
        self._count = 0  # contents in the measurement; -1: it has not begun

    @property
    def repeats(self) -> bool:
        return self.same_s >= REPEATS_S

    def clear(self) -> None:
        """Forget the source's history, because it was opened again."""
        self.same_s, self.changes, self.wrong_hz, self._window = 0.0, 0, None, None
        self._recent.clear()

    def take(self, content: Hashable, now: float, *, counts: bool = True) -> None:
        """Note a content. ``counts``: False while repetitions are normal, as for a sensor at rest."""
        if content not in self._recent:
            if self._recent:
                self.changes += 1
            self._recent.append(content)
            self.same_s = 0.0
        else:
            if counts:
                self.same_s += now - self._at
            self.alternates = content != self.content
        self.content, self._at = content, now

    def count(self, times: int, now: float) -> None:
        """Count contents, for the rate. ``times``: how many have come since the last call."""
        if self._window is None:
            self._window, self._count = now + _SETTLE_S, -1  # the source settles first
        if now < self._window:
            return
        if self._count < 0:  # settled: what came until now does not count
            self._window, self._count = now, 0
            return
        self._count += times
        seconds = now - self._window
        if seconds >= _RATE_S:
            rate, asked_hz = self._count / seconds, self._asked_hz
            is_wrong = asked_hz > 0 and abs(rate - asked_hz) > max(_TOLERANCE * asked_hz, 1 / seconds)
            self.wrong_hz = rate if is_wrong else None
            self._window, self._count = now, 0
