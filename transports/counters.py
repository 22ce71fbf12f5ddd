"""Named counters of a transport or service."""

import itertools
import threading
from collections import Counter
from collections.abc import Callable

#: Messages that were dropped: there was no room, they were too large, or the broker hangs up on their topic.
BOUNDS = ("dropped", "too_large", "too_long", "forgotten", "withheld")


class Counters:
    """Named counts, safe to add to from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._ones: dict[str, _Ones] = {}

    def add(self, name: str, amount: int = 1) -> None:
        with self._lock:
            self._counts[name] += amount

    def adder(self, name: str) -> Callable[[], object]:
        """A function that adds one, and is none of Python's own: for what is counted with every message."""
        with self._lock:
            return self._ones.setdefault(name, _Ones()).add

    def __getitem__(self, name: str) -> int:
        with self._lock:
            return self._count(name)

    def snapshot(self) -> dict[str, int]:
        with self._lock:
            names = dict.fromkeys([*self._counts, *self._ones])
            return {name: count for name in names if (count := self._count(name))}

    def _count(self, name: str) -> int:
        ones = self._ones.get(name)
        return self._counts.get(name, 0) + (0 if ones is None else ones.value())


class _Ones:
    """Counts the calls of :attr:`add`. No thread comes between the two halves of a step of ``itertools.count``."""

    def __init__(self) -> None:
        steps = itertools.count()
        self.add: Callable[[], int] = steps.__next__
        self._looks = 0

    def value(self) -> int:
        """How often ``add`` was called. To look is a step, too; one thread at a time looks."""
        self._looks += 1
        return self.add() - self._looks + 1


def bounds_reached(*several: Counters) -> dict[str, int]:
    """How many messages of these transports were dropped, by the name in BOUNDS; without zeros."""
    totals = {name: sum(counters[name] for counters in several) for name in BOUNDS}
    return {name: total for name, total in totals.items() if total}
