"""Which robots are driven from one server, as it tells others, and what others tell it. Pure."""

from collections.abc import Mapping

from pebble.contract import DRIVING, codec
from pebble.contract.identity import Identity, parse_topic
from pebble.contract.payloads import Driver
from pebble.contract.payloads import Driving as DrivingPayload
from pebble.errors import PayloadError
from pebble.transports import Message
from pebble.web.drive.driving import Lease

_EVERY_S = 1.0
_SYSTEM = "pebble"  # of the robots of most
_ANNOUNCED = 64  # in one announcement


class DrivenHere:
    """``server`` is the id of this one. Publish what ``tick`` returns.

    ``always``: it is announced on `topic` that none is driven, too.
    """

    def __init__(self, server: str) -> None:
        self.topic, self.always = DRIVING.topic(Identity(_SYSTEM, "servers", server).base), False
        self.changed: set[str] = set()  # robots whose lease is another one: announced at once
        self._server = server
        self._announced_at = float("-inf")
        self._systems: set[str] = set()  # of the robots in the last announcement

    def receive(self, message: Message) -> tuple[str, dict[str, tuple[str, str, int]]] | None:
        """Which server drives which robots, by whom, from which device and since when; None: it is none of another."""
        address = parse_topic(message.topic)
        if address is None or message.retain or address.identity.id == self._server:
            return None
        try:
            payload = codec.decode(DRIVING, message.payload)
        except PayloadError:
            return None
        return address.identity.id, {ref: (one.by, one.device, one.since) for ref, one in payload.robots.items()}

    def tick(self, leases: Mapping[str, Lease], now: float, epoch_ms: int) -> list[Message]:
        """What to publish now: once a second, and when a lease changes."""
        if now - self._announced_at < _EVERY_S and not self.changed:
            return []
        self.changed.clear()
        self._announced_at = now
        always = {_SYSTEM} if self.always else set()
        systems: dict[str, dict[str, Driver]] = {system: {} for system in self._systems | always}
        for ref, lease in list(leases.items())[:_ANNOUNCED]:
            one = Driver(by=lease.tab.user, device=lease.tab.device, since=lease.since_ms)
            systems.setdefault(ref.partition("/")[0], {})[ref] = one
        self._systems = {system for system, robots in systems.items() if robots}  # the others: once more, empty
        return [
            Message(
                DRIVING.topic(Identity(system, "servers", self._server).base),
                codec.encode(DRIVING, DrivingPayload(t=epoch_ms, robots=robots)),
            )
            for system, robots in systems.items()
        ]
