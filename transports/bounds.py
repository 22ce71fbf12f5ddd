"""Containers whose memory is bounded, in number and in bytes: other programs choose topics and payloads."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator, MutableMapping
from typing import Generic, TypeVar

V = TypeVar("V")


class BoundedQueue(Generic[V]):
    """Items in order. The oldest make room for a new one, which is never refused, however large it is."""

    def __init__(self, items: int, size: int) -> None:
        self._max_items, self._max_size = items, size
        self._items: deque[tuple[V, int]] = deque()
        self._size = 0

    def __len__(self) -> int:
        return len(self._items)

    def append(self, item: V, size: int) -> list[V]:
        """Append ``item``, of ``size`` bytes; returns the items that were dropped for it."""
        dropped = []
        while self._items and (len(self._items) >= self._max_items or self._size + size > self._max_size):
            dropped.append(self.popleft())
        self._items.append((item, size))
        self._size += size
        return dropped

    def popleft(self) -> V:
        item, size = self._items.popleft()
        self._size -= size
        return item

    def clear(self) -> None:
        self._items.clear()
        self._size = 0


class BoundedTable(MutableMapping[str, V]):
    """Values by topic, in the order in which they were set. The oldest are forgotten to make room for a new one.

    A value that is too large for the table is not stored, and removes the older one of its topic. May be changed by
    several threads.
    """

    def __init__(self, topics: int, size: int, size_of: Callable[[V], int]) -> None:
        self._max_topics, self._max_size, self._size_of = topics, size, size_of
        self._values: dict[str, V] = {}
        #: The same as ``in``, which takes a call of Python's: for what every message asks.
        self.has: Callable[[object], bool] = self._values.__contains__
        self._size = 0
        self._lock = threading.Lock()

    def __getitem__(self, topic: str) -> V:
        return self._values[topic]

    def __contains__(self, topic: object) -> bool:
        return topic in self._values

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __setitem__(self, topic: str, value: V) -> None:
        with self._lock:
            if topic in self._values:
                self._remove(topic)
            needed = self._needs(topic, value)
            if needed > self._max_size:
                return
            while self._values and not self._fits(needed):
                self._remove(next(iter(self._values)))
            self._values[topic] = value
            self._size += needed

    def __delitem__(self, topic: str) -> None:
        with self._lock:
            self._remove(topic)

    def clear(self) -> None:
        with self._lock:
            self._values.clear()
            self._size = 0

    def has_room(self, topic: str, value: V) -> bool:
        """Whether a value for a new topic fits without any other being forgotten."""
        return self._fits(self._needs(topic, value))

    def _fits(self, needed: int) -> bool:
        return len(self._values) < self._max_topics and self._size + needed <= self._max_size

    def _needs(self, topic: str, value: V) -> int:
        return len(topic) + self._size_of(value)

    def _remove(self, topic: str) -> None:
        self._size -= self._needs(topic, self._values.pop(topic))
