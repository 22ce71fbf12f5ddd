"""Which gateways receive which components at their hub, by their heartbeats at the broker. Pure."""

from collections.abc import Container

import msgspec

from pebble.contract.payloads import GatewayHeartbeat

MOST = 16  # gateways of which this is known
MOST_COMPONENTS = 2000  # of one

_decode = msgspec.json.Decoder(GatewayHeartbeat).decode


class Gateways:
    def __init__(self) -> None:
        self._robots: dict[str, frozenset[str]] = {}
        self._shown: dict[str, tuple[str, ...]] = {}

    def receive(self, name: str, heartbeat: bytes, known: Container[str]) -> dict[str, tuple[str, ...]]:
        """By component which gateways receive it, of those that are ``known`` and for which this has changed."""
        before = self._robots.pop(name, frozenset())
        try:
            robots = frozenset(_decode(heartbeat).robots[:MOST_COMPONENTS]) if heartbeat else frozenset()
        except msgspec.MsgspecError:
            robots = frozenset()
        if robots and len(self._robots) < MOST:
            self._robots[name] = robots
        found = {ref: self._of(ref) for ref in before | robots if ref in known}
        changed = {ref: names for ref, names in found.items() if self._shown.get(ref, ()) != names}
        self._shown |= changed
        for ref in [ref for ref in changed if not changed[ref]]:
            del self._shown[ref]
        return changed

    def _of(self, ref: str) -> tuple[str, ...]:
        return tuple(sorted(name for name, robots in self._robots.items() if ref in robots))
