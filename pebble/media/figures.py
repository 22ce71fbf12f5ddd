"""How much media comes, how fast and how old: figures over the last seconds. Pure: the clock is passed in."""

from __future__ import annotations

import statistics
from collections import deque

WINDOW_S = 3.0
_LIMIT = 1000  # messages that are remembered


class Figures:
    """Told of each message when it came (monotonic seconds), its bytes, and its age if that is known."""

    def __init__(self) -> None:
        self.total = 0
        self._seen: deque[tuple[float, int, float | None]] = deque(maxlen=_LIMIT)

    def add(self, now: float, size: int, age_s: float | None) -> None:
        self.total += 1
        self._seen.append((now, size, age_s))

    def rate(self, now: float) -> float:
        """Messages per second."""
        return self._per_second(now, [1] * len(self._recent(now)))

    def bitrate(self, now: float) -> float:
        """Bits of payload per second."""
        return self._per_second(now, [8 * size for _, size, _ in self._recent(now)])

    def age_s(self, now: float) -> float | None:
        """Median seconds from capture to arrival; needs both clocks to agree."""
        ages = [age for _, _, age in self._recent(now) if age is not None]
        return statistics.median(ages) if ages else None

    def _recent(self, now: float) -> list[tuple[float, int, float | None]]:
        return [one for one in self._seen if now - one[0] <= WINDOW_S]

    def _per_second(self, now: float, amounts: list[int]) -> float:
        """From the first to the last, the first one not counted: what came in the time between them."""
        recent = self._recent(now)
        if len(recent) < 2 or recent[-1][0] <= recent[0][0]:
            return 0.0
        return sum(amounts[1:]) / (recent[-1][0] - recent[0][0])
