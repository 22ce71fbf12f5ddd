"""How much media comes, how fast and how old: figures over the last seconds. Pure: the clock is passed in."""

from __future__ import annotations

import statistics
from collections import deque
from collections.abc import Callable
from typing import TypeAlias

WINDOW_S = 3.0
_LIMIT = 1000  # messages that are remembered

_Seen: TypeAlias = tuple[float, int, float | None]


class Figures:
    """Told of each message when it came (monotonic seconds), its bytes, and its age if that is known.

    One thread may tell while others look.
    """

    def __init__(self) -> None:
        self.total = 0
        self._seen: deque[_Seen] = deque(maxlen=_LIMIT)

    def add(self, now: float, size: int, age_s: float | None) -> None:
        self.total += 1
        self._seen.append((now, size, age_s))

    def rate(self, now: float) -> float:
        """Messages per second."""
        return _per_second(self._recent(now), lambda _size: 1)

    def bitrate(self, now: float) -> float:
        """Bits of payload per second."""
        return _per_second(self._recent(now), lambda size: 8 * size)

    def age_s(self, now: float) -> float | None:
        """Median seconds from capture to arrival; needs both clocks to agree."""
        ages = [age for _, _, age in self._recent(now) if age is not None]
        return statistics.median(ages) if ages else None

    def _recent(self, now: float) -> list[_Seen]:
        return [one for one in list(self._seen) if now - one[0] <= WINDOW_S]  # a copy: others may add meanwhile


def _per_second(recent: list[_Seen], amount: Callable[[int], int]) -> float:
    """From the first to the last, the first one not counted: what came in the time between them."""
    if len(recent) < 2 or recent[-1][0] <= recent[0][0]:
        return 0.0
    return sum(amount(size) for _, size, _ in recent[1:]) / (recent[-1][0] - recent[0][0])
