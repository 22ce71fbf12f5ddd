"""Named counters of a transport or service."""

from __future__ import annotations

import threading
from collections import Counter

#: Messages that were dropped because there was no room, or they were too large.
BOUNDS = ("dropped", "too_large", "too_long", "forgotten")


class Counters:
    """Named counts, safe to add to from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()

    def add(self, name: str, amount: int = 1) -> None:
        with self._lock:
            self._counts[name] += amount

    def __getitem__(self, name: str) -> int:
        with self._lock:
            return self._counts[name]

    def snapshot(self) -> dict[str, int]:
        with self._lock:
            return dict(self._counts)


def bounds_reached(*several: Counters) -> dict[str, int]:
    """How many messages of these transports were dropped, by the name in BOUNDS; without zeros."""
    totals = {name: sum(counters[name] for counters in several) for name in BOUNDS}
    return {name: total for name, total in totals.items() if total}
