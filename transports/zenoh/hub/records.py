"""Records of a hub and its journal: retained messages and wills."""

from __future__ import annotations

import msgspec

from pebble.transports.zenoh.wire import Stamp, Will


class Retained(msgspec.Struct, frozen=True, array_like=True, tag="kept"):
    """A retained message, or the removal of one if ``payload`` is empty."""

    key: str
    payload: bytes
    stamp: Stamp

    @property
    def id(self) -> str:
        """Name of the record; it replaces an earlier record of the same name."""
        return f"kept {self.key}"

    @property
    def is_removal(self) -> bool:
        return not self.payload


class StoredWill(msgspec.Struct, frozen=True, array_like=True, tag="will"):
    """A client's will, or its withdrawal."""

    name: str
    will: Will | None

    @property
    def id(self) -> str:
        """Name of the record; it replaces an earlier record of the same name."""
        return f"will {self.name}"

    @property
    def is_removal(self) -> bool:
        return self.will is None


Record = Retained | StoredWill
