"""Containers whose memory is limited, in number and in bytes, because other programs choose topics and payloads."""

import threading
from collections import deque
from collections.abc import Callable, Iterator, MutableMapping
from typing import Generic, TypeVar

V = TypeVar("V")


class BoundedQueue(Generic[V]):
    """A queue of items. The oldest make room for a new item, which is never refused, however large it is."""

    def __init__(self, items: int, size: int) -> None:
        self._max_items, self._max_size = items, size
        self._items: deque[tuple[V, int]] = deque()
        self._size = 0

    def __len__(self) -> int:
        return len(self._items)

    def append(self, item: V, size: int) -> list[V]:
        """Append ``item``, of ``size`` bytes; return the items that were dropped for it."""
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
    """A table of values by topic, in the order in which they were set. The oldest are forgotten to make room.

    A value that is too large for the table is not stored, and removes the older value of its topic. Several threads may
    change the table. ``size``: the most bytes, of topics and of values, as ``size_of`` counts those.
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
        self._put(topic, value, forget=True)

    def put_if_room(self, topic: str, value: V) -> bool:
        """Store the value if no other topic has to be forgotten for it; return True if it is stored."""
        return self._put(topic, value, forget=False)

    def __delitem__(self, topic: str) -> None:
        with self._lock:
            self._remove(topic)

    def clear(self) -> None:
        with self._lock:
            self._values.clear()
            self._size = 0

    def _put(self, topic: str, value: V, *, forget: bool) -> bool:  # forget: remove the oldest if there is no room
        needed = len(topic) + self._size_of(value)
        with self._lock:
            values = self._values
            if topic in values:
                self._remove(topic)
            while len(values) >= self._max_topics or self._size + needed > self._max_size:
                if not forget or needed > self._max_size:
                    return False
                self._remove(next(iter(values)))
            values[topic] = value
            self._size += needed
            return True

    def _remove(self, topic: str) -> None:
        self._size -= len(topic) + self._size_of(self._values.pop(topic))
