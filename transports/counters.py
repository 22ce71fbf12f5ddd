"""Named counters of a transport or service.

Every transport counts ``sent``, ``refused`` (not accepted), ``parked`` (retained messages waiting for a connection),
``received``, ``delivered`` (handler calls), ``handler_errors``, ``dropped`` (by a bounded queue), ``stale`` (T8),
``connected`` (times) and ``forgotten`` (retained messages beyond what a transport stores to send them again). MQTT adds
``echoes`` (own retained messages that came back), ``unconfirmed`` (accepted, and lost with the connection),
``silences`` (T19), ``subscriptions_refused``, ``publications_refused``, ``malformed``, ``too_long``, ``too_large`` and
``withheld``; Zenoh adds ``late`` (T19).
"""

import threading
from collections import Counter
from collections.abc import Callable, Mapping
from functools import partial

#: Messages that were dropped: there was no room, they were too large, or the broker hangs up on their topic.
BOUNDS = ("dropped", "too_large", "too_long", "forgotten", "withheld")


class Counters:
    """Named counts, safe to add to from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()

    def add(self, name: str, amount: int = 1) -> None:
        with self._lock:
            self._counts[name] += amount

    def adder(self, name: str) -> Callable[[], object]:
        """Return a function that adds one."""
        return partial(self.add, name)

    def __getitem__(self, name: str) -> int:
        with self._lock:
            return self._counts[name]

    def snapshot(self) -> dict[str, int]:
        with self._lock:
            return {name: count for name, count in self._counts.items() if count}


def in_words(counts: Mapping[str, int]) -> str:
    """Return ``sent 3, dropped 1``; ``none`` if there are none."""
    return ", ".join(f"{name} {count}" for name, count in counts.items()) or "none"


def bounds_reached(*several: Counters) -> dict[str, int]:
    """Return how many messages were dropped by limits, by the limit's name in BOUNDS; without zeros."""
    totals = {name: sum(counters[name] for counters in several) for name in BOUNDS}
    return {name: total for name, total in totals.items() if total}
