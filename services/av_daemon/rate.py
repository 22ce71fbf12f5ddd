"""How often something happens, over the last seconds. Clock values are passed in."""

from __future__ import annotations

from collections import deque

_WINDOW_S = 3.0
_LIMIT = 4096  # stamps kept


class Rate:
    """Events per second, measured between the first and the last event of the last 3 s."""

    def __init__(self) -> None:
        self._stamps: deque[float] = deque(maxlen=_LIMIT)

    def count(self, now: float) -> None:
        self._stamps.append(now)

    def clear(self) -> None:
        self._stamps.clear()

    def per_second(self, now: float) -> float:
        """0 when there were fewer than two events."""
        recent = [stamp for stamp in self._stamps if now - stamp <= _WINDOW_S]
        return 0.0 if len(recent) < 2 or recent[-1] <= recent[0] else (len(recent) - 1) / (recent[-1] - recent[0])
