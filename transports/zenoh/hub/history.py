"""When a hub received each retained message, and what was removed: what other hubs need to merge with it. Pure."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from pebble.transports import clock
from pebble.transports.zenoh.hub.records import Retained

MAX_REMOVALS = 10_000  # that are remembered; the oldest are forgotten first
MAX_BYTES = 4 << 20  # of their keys and origins
REMOVAL_S = 7 * 86_400.0

_NEVER = float("-inf")


class History:
    """By keys. What a journal had came an unknown time ago: its age is infinite."""

    def __init__(self, now: Callable[[], float] = clock.since_boot) -> None:
        self._now = now
        self._arrived: dict[str, float] = {}
        self._removed: dict[str, Retained] = {}
        self._what: dict[str, int | None] = {}  # digests of what was removed, None where that is not known
        self._bytes = 0
        self._began = now()  # since when removals of a journal are remembered

    def add(self, record: Retained, age_s: float, before: int | None) -> None:
        """``record`` was stored, or what has the digest ``before`` was removed by it; ``age_s`` seconds ago."""
        self._forget(record.key)
        self._arrived[record.key] = self._now() - age_s
        if not record.payload:
            self._removed[record.key] = record
            self._what[record.key] = before
            self._bytes += _size(record)
            self._forget_old()

    def know(self, key: str, age_s: float) -> None:
        """What a journal had under ``key`` is ``age_s`` seconds old."""
        if self.age_s(key) == float("inf") and key in self._arrived:
            self._arrived[key] = self._now() - age_s

    def age_s(self, key: str) -> float:
        return max(0.0, self._now() - self._arrived.get(key, _NEVER))

    def removal(self, key: str) -> Retained | None:
        """The removal of what was retained under ``key``, if it was the last that happened to it."""
        return self._removed.get(key)

    def removed_by_another(self, key: str, digest: int, name: str) -> bool:
        """Whether another client than ``name`` has removed just this, and not what it has written since."""
        removal, what = self._removed.get(key), self._what.get(key)
        return removal is not None and removal.stamp.origin != name and what in (None, digest)

    def removals(self) -> Iterator[Retained]:
        yield from self._removed.values()

    def _forget_old(self) -> None:
        while self._removed:
            oldest = next(iter(self._removed))
            is_old = self._now() - max(self._arrived[oldest], self._began) > REMOVAL_S
            if not is_old and len(self._removed) <= MAX_REMOVALS and self._bytes <= MAX_BYTES:
                return
            self._forget(oldest)

    def _forget(self, key: str) -> None:
        removal = self._removed.pop(key, None)
        if removal is not None:
            self._bytes -= _size(removal)
            del self._arrived[key], self._what[key]


def _size(removal: Retained) -> int:
    return len(removal.key) + len(removal.stamp.origin)
