"""What the hub remembers: kept copies and parked wills. Pure data; order is arrival, never a clock."""

from __future__ import annotations

import logging
from collections.abc import Iterator

import msgspec

from pebble.transports.zenoh_wire import Hello, Stamp, Will, digest

log = logging.getLogger(__name__)

MAX_BYTES = 64 << 20  # of kept keys and payloads together
MAX_WILLS = 1000


class Kept(msgspec.Struct, frozen=True, array_like=True, tag="kept"):
    """One kept copy, or the removal of one if ``payload`` is empty."""

    key: str
    payload: bytes
    stamp: Stamp


class Parked(msgspec.Struct, frozen=True, array_like=True, tag="will"):
    """A client's will, or its withdrawal."""

    name: str
    will: Will | None


Record = Kept | Parked


class KeptStore:
    """The newest kept copy of every key and the wills of living clients, bounded in bytes and in number."""

    def __init__(self) -> None:
        self.refused = 0  # records there was no room for
        self._kept: dict[str, Kept] = {}
        self._wills: dict[str, Will] = {}
        self._bytes = 0

    def apply(self, record: Record) -> bool:
        """Take in what arrived; False if it changes nothing or there is no room."""
        if isinstance(record, Kept):
            return self._keep(record)
        return self._park(record)

    def get(self, key: str) -> Kept | None:
        return self._kept.get(key)

    def kept(self) -> list[Kept]:
        return list(self._kept.values())

    def wills(self) -> set[str]:
        return set(self._wills)

    def will(self, name: str) -> Will | None:
        return self._wills.get(name)

    def records(self) -> Iterator[Record]:
        """Everything needed to make an equal store."""
        yield from self._kept.values()
        for name, will in self._wills.items():
            yield Parked(name, will)

    def lacks(self, hello: Hello) -> list[str]:
        """The keys this client should send: those missing here, and its own that differ from what it has now.

        What another client wrote later stays: that it did so is its business.
        """
        return [key for key, own in hello.own.items() if self._differs(self._kept.get(key), own, hello.name)]

    @staticmethod
    def _differs(kept: Kept | None, own: int | None, name: str) -> bool:
        if kept is None:
            return own is not None
        return kept.stamp.origin == name and digest(kept.payload) != own

    def _keep(self, record: Kept) -> bool:
        before = self._kept.pop(record.key, None)
        grown = _size(record) if record.payload else 0
        shrunk = _size(before) if before is not None else 0
        if grown and self._bytes - shrunk + grown > MAX_BYTES:
            self._refuse(f"kept copy of {record.key}")
            grown = 0  # better none than an old one
        elif grown:
            self._kept[record.key] = record
        self._bytes += grown - shrunk
        return before != self._kept.get(record.key)

    def _park(self, record: Parked) -> bool:
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


def _size(record: Kept) -> int:
    return len(record.key) + len(record.payload)
