"""The subscriptions of one transport."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import TYPE_CHECKING

from pebble.transports.topics import REMEMBERED_LENGTH, matches

if TYPE_CHECKING:
    from pebble.transports.base import Subscription

_MATCHED = 512  # topics whose subscriptions are remembered


class Subscriptions:
    """A list that knows which of them match a topic; any thread may use it."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.matched: dict[str, tuple[Subscription, ...]] = {}  # by topic; empty after each change
        self._all: list[Subscription] = []

    def __iter__(self) -> Iterator[Subscription]:
        """Those of this moment."""
        with self.lock:
            return iter(list(self._all))

    def add(self, subscription: Subscription) -> None:
        with self.lock:
            self._all.append(subscription)
            self.matched.clear()

    def remove(self, subscription: Subscription) -> bool:
        """Whether it was one of them."""
        with self.lock:
            if subscription not in self._all:
                return False
            self._all.remove(subscription)
            self.matched.clear()
            return True

    def remove_all(self) -> list[Subscription]:
        with self.lock:
            removed, self._all = self._all, []
            self.matched.clear()
            return removed

    def matching(self, topic: str) -> tuple[Subscription, ...]:
        """Remembered by topic: matching takes longer than everything else that happens to a message here."""
        with self.lock:
            found = self.matched.get(topic)
            if found is None:
                found = tuple(one for one in self._all if matches(one.filter, topic))
                if len(self.matched) >= _MATCHED:
                    self.matched.clear()
                if len(topic) <= REMEMBERED_LENGTH:
                    self.matched[topic] = found
            return found
