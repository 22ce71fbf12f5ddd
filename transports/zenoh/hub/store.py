"""The hub's data: retained messages and wills. Pure; the order of arrival decides, never a clock."""

from __future__ import annotations

import logging
from collections.abc import Iterator

from pebble.transports.zenoh.hub.records import Record, Retained, StoredWill
from pebble.transports.zenoh.wire import Hello, Will, digest

log = logging.getLogger(__name__)

MAX_BYTES = 64 << 20  # of retained messages and wills together
MAX_WILLS = 1000  # of all sessions; a further one is refused
OVERHEAD = 400  # bytes of Python's objects for one record, about


class HubStore:
    """The newest retained message of every key and the wills of running clients, bounded in bytes and in number.

    A record without room is refused, and changes nothing.
    """

    def __init__(self, max_wills: int | None = None) -> None:
        self.refused = 0  # records there was no room for
        self._max_wills = MAX_WILLS if max_wills is None else max_wills
        self._retained: dict[str, Retained] = {}
        self._wills: dict[str, Will] = {}
        self._bytes = 0

    def apply(self, record: Record) -> bool:
        """Store a record; False if it changes nothing, or there is no room."""
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
        """Yield records that rebuild this store."""
        yield from self._retained.values()
        for name, will in self._wills.items():
            yield StoredWill(name, will)

    def lacks(self, hello: Hello) -> list[str]:
        """Return the keys that this client should send: those missing here, and those with an older value of its own.

        A later value, or removal, by another client stays.
        """
        return [key for key, its_digest in hello.own.items() if self._differs(key, its_digest, hello.name)]

    def _differs(self, key: str, its_digest: int | None, client: str) -> bool:
        """True if ``client`` should send its value of ``key``. ``its_digest``: of that value; None: it was removed."""
        retained = self._retained.get(key)
        if retained is None:
            return its_digest is not None
        return retained.stamp.origin == client and digest(retained.payload) != its_digest

    def _store_retained(self, record: Retained) -> bool:
        """Store a retained message, or remove it if ``record`` has no payload; return as `apply` does."""
        before = self._retained.get(record.key)
        after = record if record.payload else None
        if not self._resize(_size(after) - _size(before)):
            self._refuse(f"retained message of {record.key}")
            return False
        if after is None:
            self._retained.pop(record.key, None)
        else:
            self._retained[record.key] = record
        return before != after

    def _store_will(self, record: StoredWill) -> bool:
        """Store a will, or remove it if ``record`` has none; return as `apply` does."""
        name, before, after = record.name, self._wills.get(record.name), record.will
        if after is not None:
            full = before is None and len(self._wills) >= self._max_wills
            if full or not self._resize(_size(after)):  # for a moment it needs room beside the earlier one
                self._refuse(f"will of {name}")
                return False
            self._wills[name] = after
        elif before is not None:
            del self._wills[name]
        if before is not None:
            self._resize(-_size(before))
        return before != after

    def _resize(self, grown: int) -> bool:
        """Account for ``grown`` more bytes (negative: fewer); False if there is no room for them."""
        if grown > 0 and self._bytes + grown > MAX_BYTES:
            return False
        self._bytes += grown
        return True

    def _refuse(self, what: str) -> None:
        self.refused += 1
        if self.refused & (self.refused - 1) == 0:  # the 1st, 2nd, 4th, 8th…
            log.error("no room for the %s: %d refused so far", what, self.refused)


def _size(message: Retained | Will | None) -> int:
    if message is None:
        return 0
    if isinstance(message, Retained):
        name, sender = message.key, message.stamp.origin
    else:
        name, sender = message.topic, message.client
    return OVERHEAD + len(name) + len(sender) + len(message.payload)
