"""The hub's data: retained messages and wills. Pure; the order of arrival decides, never a clock."""

from __future__ import annotations

import logging
from collections.abc import Iterator

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
    ``reserved``.
    """

    def __init__(self, reserved: tuple[str, ...] = (), max_wills: int | None = None) -> None:
        self.refused = 0  # records there was no room for
        self._reserved = reserved
        self._max_wills = MAX_WILLS if max_wills is None else max_wills
        self._retained: dict[str, Retained] = {}
        self._wills: dict[str, Will] = {}
        self._bytes = {True: 0, False: 0}  # by whether the key is reserved
        self._bytes_of: dict[str, int] = {}  # by robot, if none is reserved

    def apply(self, record: Record) -> bool:
        """Store a record; False if it changes nothing or there is no room."""
        return self._store_retained(record) if isinstance(record, Retained) else self._store_will(record)

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
            return own is not None
        return retained.stamp.origin == name and digest(retained.payload) != own

    def _store_retained(self, record: Retained) -> bool:
        before = self._retained.get(record.key)
        after = record if record.payload else None
        if not self._resize(record.key, _size(after) - _size(before)):
            self._refuse(f"retained message of {record.key}")
            return False
        if after is None:
            self._retained.pop(record.key, None)
        else:
            self._retained[record.key] = record
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
