"""Topics that a self-describing MCU wants kept on the robot: learnt from its manifest."""

from __future__ import annotations

from collections.abc import Iterator

from pebble import codec
from pebble.contract import MCU_DESCRIBE, MCU_VALUE, OUTGOING
from pebble.errors import PayloadError
from pebble.payloads import McuManifest
from pebble.transports import Message

_PROTOCOL = "pebble_serial_v1"
_DEVICES = 256  # remembered; a robot has a handful


class PrivateTopics:
    """The ``local_only`` interfaces of every MCU, under their generic and their alias topic."""

    def __init__(self, base: str) -> None:
        self._base = base
        self._of: dict[str, frozenset[str]] = {}  # by topic of the manifest: a new one replaces the old
        self._all: frozenset[str] = frozenset()

    def __contains__(self, topic: str) -> bool:
        return topic in self._all

    def learn(self, message: Message) -> None:
        """Take in a manifest; a malformed or foreign one changes nothing."""
        try:
            manifest = codec.decode(MCU_DESCRIBE, message.payload)
        except PayloadError:
            return
        if manifest.protocol != _PROTOCOL or (message.topic not in self._of and len(self._of) >= _DEVICES):
            return
        self._of[message.topic] = frozenset(self._topics(manifest))
        self._all = frozenset().union(*self._of.values())

    def _topics(self, manifest: McuManifest) -> Iterator[str]:
        for interface in manifest.interfaces:
            if interface.get("local_only") is not True:
                continue
            yield MCU_VALUE.topic(self._base, uid=manifest.device_uid, name=str(interface.get("name")))
            if interface.get("channel"):
                yield f"{self._base}/{OUTGOING}/{interface['channel']}"
