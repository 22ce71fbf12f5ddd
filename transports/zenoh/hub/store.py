"""The hub's data: retained messages and wills. Pure; the order of arrival decides, never a clock."""

from __future__ import annotations

import logging
from collections.abc import Iterator

import msgspec

from pebble.transports.zenoh.wire import Hello, Stamp, Will, digest

log = logging.getLogger(__name__)

MAX_BYTES = 64 << 20  # of retained keys and payloads together
MAX_WILLS = 1000


class Retained(msgspec.Struct, frozen=True, array_like=True, tag="kept"):
    """One retained message, or the removal of one if ``payload`` is empty."""

    key: str
    payload: bytes
    stamp: Stamp


class StoredWill(msgspec.Struct, frozen=True, array_like=True, tag="will"):
    """A client's will, or its withdrawal."""

    name: str
    will: Will | None


Record = Retained | StoredWill


class HubStore:
    """The newest retained message of every key and the wills of running clients, bounded in bytes and in number."""

    def __init__(self) -> None:
        self.refused = 0  # records there was no room for
        self._retained: dict[str, Retained] = {}
        self._wills: dict[str, Will] = {}
        self._bytes = 0

    def apply(self, record: Record) -> bool:
        """Store a record; False if it changes nothing or there is no room."""
        if isinstance(record, Retained):
            return self._store_retained(record)
        return self._store_will(record)

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

        A value that another client wrote later stays.
        """
        return [key for key, own in hello.own.items() if self._differs(self._retained.get(key), own, hello.name)]

    @staticmethod
    def _differs(retained: Retained | None, own: int | None, name: str) -> bool:
        if retained is None:
            return own is not None
        return retained.stamp.origin == name and digest(retained.payload) != own

    def _store_retained(self, record: Retained) -> bool:
        before = self._retained.pop(record.key, None)
        grown = _size(record) if record.payload else 0
        shrunk = _size(before) if before is not None else 0
        if grown and self._bytes - shrunk + grown > MAX_BYTES:
            self._refuse(f"retained message of {record.key}")
            grown = 0  # no value is better than an old one
        elif grown:
            self._retained[record.key] = record
        self._bytes += grown - shrunk
        return before != self._retained.get(record.key)

    def _store_will(self, record: StoredWill) -> bool:
        before = self._wills.pop(record.name, None)
        if record.will is not None and len(self._wills) >= MAX_WILLS:
            self._refuse(f"will of {record.name}")
        elif record.will is not None:
            self._wills[record.name] = record.will
        return before != record.will

    def _refuse(self, what: str) -> None:
        self.refused += 1
        if self.refused & (self.refused - 1) == 0:  # the 1st, 2nd, 4th, 8th…
            log.error("no room for the %s: %d refused so far", what, self.refused)


def _size(record: Retained) -> int:
    return len(record.key) + len(record.payload)
