"""Packets and bits per second, from totals that are looked at now and then. Pure: the clock is passed in."""

from __future__ import annotations

from collections import deque


class Rates:
    """Averages over the last ``span`` looks."""

    def __init__(self, span: int = 3) -> None:
        self._totals: deque[tuple[float, int, int]] = deque(maxlen=span + 1)  # time, packets, bytes

    def look(self, packets: int, size: int, now: float) -> tuple[float, float]:
        """Given all packets and bytes until now: packets and bits per second."""
        self._totals.append((now, packets, size))
        then, packets_then, size_then = self._totals[0]
        seconds = now - then
        return ((packets - packets_then) / seconds, 8 * (size - size_then) / seconds) if seconds > 0 else (0.0, 0.0)
