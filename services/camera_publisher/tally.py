"""Frames and bytes per second, over the last seconds. Pure: times are passed in."""

from __future__ import annotations

from collections import deque

_WINDOW_S = 3.0


class Tally:
    """Counts what is ``add``-ed at a time."""

    def __init__(self) -> None:
        self._seen: deque[tuple[float, int]] = deque()
        self._since: float | None = None  # when counting began

    def start(self, now: float) -> None:
        """Count anew."""
        self._seen.clear()
        self._since = now

    def add(self, size: int, now: float) -> None:
        if self._since is None:
            self._since = now
        self._seen.append((now, size))

    def rates(self, now: float) -> tuple[float, float]:
        """Frames per second, and bytes per second."""
        while self._seen and now - self._seen[0][0] > _WINDOW_S:
            self._seen.popleft()
        span = min(_WINDOW_S, now - self._since) if self._since is not None else 0.0
        if span <= 0:
            return 0.0, 0.0
        return len(self._seen) / span, sum(size for _, size in self._seen) / span
