"""Subscribers' queries that wait in the hub for retained messages which are known to be on their way."""

from collections import deque
from typing import NamedTuple

import zenoh

QUERIES = 1000  # that wait; further ones are answered at once
PATIENCE_S = 0.5  # so long each waits


class _Waiting(NamedTuple):
    """A query that is answered once ``needs`` are here, or at ``until``."""

    until: float
    needs: dict[str, int]  # how many retained messages, by client
    query: zenoh.Query


class WaitingQueries:
    """Queries that wait, each until a given number of retained messages of each client is here. Not thread-safe."""

    def __init__(self) -> None:
        self._received: dict[str, int] = {}  # how many retained messages have arrived, by client
        self._waiting: deque[_Waiting] = deque()  # oldest first
        self._awaited: set[str] = set()  # clients whose messages these wait for
        self._some_arrived = False  # such a message came, so that some query may have all that it needs

    def count_from(self, client: str, count: int) -> None:
        """Note that this client has sent ``count`` retained messages until now, and that all of them are here."""
        self._received[client] = count

    def received(self, client: str, count: int) -> None:
        """Note the ``count``-th retained message of this client; 0: the client does not count its messages."""
        if count and client in self._received:
            self._received[client] = max(count, self._received[client])
            self._some_arrived = self._some_arrived or client in self._awaited

    def forget(self, client: str) -> None:
        self._received.pop(client, None)

    def forget_all(self) -> None:
        self._received.clear()

    def add(self, needs: dict[str, int], query: zenoh.Query, now: float) -> bool:
        """Let a query wait; False if it must be answered now."""
        if len(self._waiting) >= QUERIES or self._has_arrived(needs):
            return False
        self._waiting.append(_Waiting(now + PATIENCE_S, needs, query))
        self._awaited.update(needs)
        return True

    def due(self) -> float:
        """Return the time at which to call :meth:`take`; infinite if nothing waits."""
        if not self._waiting:
            return float("inf")
        return float("-inf") if self._some_arrived else self._waiting[0].until

    def take(self, now: float) -> list[zenoh.Query]:
        """Remove and return the queries to answer now: nothing is missing for them, or they have waited long enough."""
        due = []
        while self._waiting and now >= self._waiting[0].until:
            due.append(self._waiting.popleft())
        if self._some_arrived:
            self._some_arrived = False
            due += [entry for entry in self._waiting if self._has_arrived(entry.needs)]
            self._waiting = deque(entry for entry in self._waiting if not self._has_arrived(entry.needs))
        if not self._waiting:
            self._awaited.clear()
        return [entry.query for entry in due]

    def drop(self) -> None:
        """Drop all queries without an answer."""
        for entry in self._waiting:
            entry.query.drop()  # type: ignore[no-untyped-call]
        self._waiting.clear()

    def _has_arrived(self, needs: dict[str, int]) -> bool:
        return all(self._received.get(name, -1) >= count for name, count in needs.items())
