"""What arrives at a hub takes a place and waits for its turn on the hub's thread: callbacks of Zenoh's threads."""

from __future__ import annotations

import time
from collections.abc import Callable

import zenoh

from pebble.transports.zenoh import wire
from pebble.transports.zenoh.hub.records import robot_of
from pebble.transports.zenoh.hub.store import OVERHEAD
from pebble.transports.zenoh.hub.turns import Places, Task, Turns

ASKED = 2000  # queries that wait for the hub's thread; beyond it …
SENDERS = 8  # … their senders wait, each connection in its turn; more would take the threads that receive stops
HELLOS = 8  # of one account that wait
ASKED_BYTES = 128 << 10  # of one hello, some 2,000 retained topics, or query
RETAINING_BYTES = 1 << 20  # of retained messages of one robot that wait; beyond it their senders wait, as above
COMING = 100  # sessions of one account that come or go; the same

_OnQuery = Callable[[zenoh.Query], None]
_OnSample = Callable[[zenoh.Sample], None]


class Intake:
    """One queue for all messages and queries, in the order of their arrival, and room for each sender that is bounded.

    Each method but :meth:`take`, :meth:`end` and :meth:`answered` queues ``work``, which the hub's thread does.
    """

    def __init__(self) -> None:
        self._turns = Turns()
        self._asking, self._greeting = Places(ASKED, SENDERS), Places(HELLOS)
        self._retaining, self._coming = Places(RETAINING_BYTES, SENDERS), Places(COMING, SENDERS)
        self.take, self.end = self._turns.take, self._turns.end

    def put(self, work: Task) -> None:
        self._turns.put(work)

    def retain(self, work: _OnSample, sample: zenoh.Sample) -> None:
        """A message is to be stored, in the room that waiting ones of its robot have: others come in between."""
        name = robot_of(str(sample.key_expr).removeprefix(wire.RETAINED))
        size = OVERHEAD + len(sample.payload)

        def store() -> None:
            self._retaining.leave(name, size)
            work(sample)

        if self._retaining.take(name, size):
            self.put(store)

    def come(self, work: _OnSample, sample: zenoh.Sample) -> None:
        """A client is there, or is gone; those of an account in the room that it has."""
        account, of, _ = str(sample.key_expr).removeprefix(wire.LIVE).partition(wire.OF)

        def note() -> None:
            if of:
                self._coming.leave(account)
            work(sample)

        if not of or self._coming.take(account):
            self.put(note)

    def greet(self, work: _OnQuery, query: zenoh.Query) -> None:
        """An account says hello or goodbye."""
        account = str(query.key_expr).rpartition("/")[2]

        def greet() -> None:
            self._greeting.leave(account)
            work(query)

        if _admits(query, self._greeting, account):
            self._turns.ask("hellos", account, greet)

    def ask(self, work: _OnQuery, query: zenoh.Query) -> None:
        """A query for retained messages holds its place until it is :meth:`answered`."""
        if _admits(query, self._asking, ""):
            self.in_turn(work, query)

    def in_turn(self, work: _OnQuery, query: zenoh.Query) -> None:
        """A query that has its place comes in turn with those for other keys, as a hub is not told who asks.

        One that has waited for too long is dropped.
        """
        came = time.monotonic()

        def turn() -> None:
            if time.monotonic() - came < wire.RETAINED_ANSWER_S:
                work(query)
            else:
                query.drop()  # type: ignore[no-untyped-call]
                self.answered()

        self._turns.ask("queries", str(query.key_expr), turn)

    def answered(self) -> None:
        """A query has had its answer, or gets none."""
        self._asking.leave()

    @property
    def asked(self) -> int:
        """How many queries hold a place."""
        return self._asking.taken.get("", 0)


def _admits(query: zenoh.Query, places: Places, name: str) -> bool:
    """Whether there is a place for a query that is short enough; else it is answered with nothing."""
    admitted = (query.payload is None or len(query.payload) <= ASKED_BYTES) and places.take(name)
    if not admitted:
        query.drop()  # type: ignore[no-untyped-call]
    return admitted
