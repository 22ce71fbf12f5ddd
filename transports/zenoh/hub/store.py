"""The hub's data: retained messages and wills. Pure; the order of arrival decides, never a clock."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping

from pebble.transports.zenoh.hub.history import History
from pebble.transports.zenoh.hub.merge import Row, Value
from pebble.transports.zenoh.hub.records import Record, Retained, StoredWill, robot_of
from pebble.transports.zenoh.keymap import topic_to_key
from pebble.transports.zenoh.wire import Hello, Will, digest

log = logging.getLogger(__name__)

MAX_BYTES = 64 << 20  # of retained messages and wills together
ROBOT_BYTES = 8 << 20  # of them for the keys of one robot, at a hub of several: none fills the room of all
RESERVED_BYTES = 16 << 20  # of them, for keys that are reserved: other clients cannot fill these
MAX_WILLS = 1000
RESERVED_WILLS = 100  # of them, for the same keys
OVERHEAD = 400  # bytes of Python's objects for one record, about


class HubStore:
    """The newest retained message of every key and the wills of running clients, bounded in bytes and in number.

    What has no room is refused, and changes nothing. A part of the room is for keys that begin with one of
    ``reserved``. ``history``: of a hub that others are linked to.
    """

    def __init__(
        self, reserved: tuple[str, ...] = (), history: History | None = None, max_wills: int | None = None
    ) -> None:
        self.refused = 0  # records there was no room for
        self._reserved = reserved
        self._history = history
        self._max_wills = MAX_WILLS if max_wills is None else max_wills
        self._retained: dict[str, Retained] = {}
        self._wills: dict[str, Will] = {}
        self._bytes = {True: 0, False: 0}  # by whether the key is reserved
        self._bytes_of: dict[str, int] = {}  # by robot, if none is reserved

    def empty(self) -> HubStore:
        """An empty one with the same room."""
        return HubStore(self._reserved, None if self._history is None else History(), self._max_wills)

    def apply(self, record: Record, age_s: float = 0.0) -> bool:
        """Store a record, which is ``age_s`` seconds old; False if it changes nothing or there is no room."""
        if isinstance(record, Retained):
            return self._store_retained(record, age_s)
        return self._store_will(record)

    def take_over(self, newer: HubStore) -> None:
        """Apply what another store has, which is newer than all that is here, at its age."""
        for record in newer.records():
            age_s = newer.age_s(record.key) if isinstance(record, Retained) else 0.0
            self.apply(record, age_s)

    def get(self, key: str) -> Retained | None:
        return self._retained.get(key)

    def retained(self) -> list[Retained]:
        return list(self._retained.values())

    def wills(self) -> set[str]:
        return set(self._wills)

    def will(self, name: str) -> Will | None:
        return self._wills.get(name)

    def records(self) -> Iterator[Record]:
        """The records that make an equal store."""
        if self._history is not None:
            yield from self._history.removals()
        yield from self._retained.values()
        for name, will in self._wills.items():
            yield StoredWill(name, will)

    def lacks(self, hello: Hello) -> list[str]:
        """The keys this client should send: those missing here, and those it wrote itself that differ now.

        A value that another client wrote later stays, and so does that another one has removed it.
        """
        return [key for key, own in hello.own.items() if self._differs(key, own, hello.name)]

    def _differs(self, key: str, own: int | None, name: str) -> bool:
        retained = self._retained.get(key)
        if retained is None:
            return own is not None and (self._history is None or not self._history.removed_by_another(key, own, name))
        return retained.stamp.origin == name and digest(retained.payload) != own

    # -- among several hubs

    @property
    def has_history(self) -> bool:
        """Whether other hubs may merge with it."""
        return self._history is not None

    def age_s(self, key: str) -> float:
        return 0.0 if self._history is None else self._history.age_s(key)

    def know(self, ages: Mapping[str, float]) -> None:
        """How old are those of ``ages`` that were here before a restart."""
        for key, age_s in ages.items():
            if self._history is not None:
                self._history.know(key, age_s)

    def table(self) -> dict[str, Row]:
        """What is here, and what was removed, for another hub."""
        removals = () if self._history is None else self._history.removals()
        return {record.key: self._row(record) for record in (*removals, *self._retained.values())}

    def row(self, key: str) -> Row | None:
        record = self._last(key)
        return None if record is None else self._row(record)

    def _last(self, key: str) -> Retained | None:
        """What is retained, or the removal of it."""
        return self._retained.get(key) or (None if self._history is None else self._history.removal(key))

    def _row(self, record: Retained) -> Row:
        stamp, of = record.stamp, digest(record.payload) if record.payload else None
        return Row(of, stamp.origin, stamp.retained_count, self.age_s(record.key))

    def values(self, keys: Iterable[str]) -> Iterator[Value]:
        """The rows of ``keys`` with their payloads."""
        for key in keys:
            if (record := self._last(key)) is not None:
                stamp = record.stamp
                yield Value(key, record.payload, stamp.qos, stamp.retained_count, stamp.origin, self.age_s(key))

    def _store_retained(self, record: Retained, age_s: float) -> bool:
        before = self._retained.get(record.key)
        after = record if record.payload else None
        if not self._resize(record.key, _size(after) - _size(before)):
            self._refuse(f"retained message of {record.key}")
            return False
        if after is None:
            self._retained.pop(record.key, None)
        else:
            self._retained[record.key] = record
        if self._history is not None and (after or before or age_s):  # else nothing was removed
            self._history.add(record, age_s, None if before is None else digest(before.payload))
        return before != after

    def _store_will(self, record: StoredWill) -> bool:
        name, before, after = record.name, self._wills.get(record.name), record.will
        if after is not None:
            key = topic_to_key(after.topic)
            outside = self._reserved and not key.startswith(self._reserved)
            most = self._max_wills - RESERVED_WILLS if outside else self._max_wills
            full = before is None and len(self._wills) >= most
            if full or not self._resize(key, _size(after)):
                self._refuse(f"will of {name}")
                return False
            self._wills[name] = after
        elif before is not None:
            del self._wills[name]
        if before is not None:
            self._resize(topic_to_key(before.topic), -_size(before))
        return before != after

    def _resize(self, key: str, grown: int) -> bool:
        """Account for ``grown`` bytes more, or less, of ``key``; False if there is no room for them."""
        reserved, robot = key.startswith(self._reserved), robot_of(key)
        of_robot = 0 if self._reserved else self._bytes_of.get(robot, 0) + grown
        if grown > 0:
            full = sum(self._bytes.values()) + grown > MAX_BYTES or of_robot > ROBOT_BYTES
            if full or (self._reserved and not reserved and self._bytes[False] + grown > MAX_BYTES - RESERVED_BYTES):
                return False
        self._bytes[reserved] += grown
        if of_robot:
            self._bytes_of[robot] = of_robot
        else:
            self._bytes_of.pop(robot, None)
        return True

    def _refuse(self, what: str) -> None:
        self.refused += 1
        if self.refused & (self.refused - 1) == 0:  # the 1st, 2nd, 4th, 8th…
            log.error("no room for the %s: %d refused so far", what, self.refused)


def _size(message: Retained | Will | None) -> int:
    if message is None:
        return 0
    if isinstance(message, Retained):
        where, who = message.key, message.stamp.origin
    else:
        where, who = message.topic, message.client
    return OVERHEAD + len(where) + len(who) + len(message.payload)
