"""Brokers, bridges and other ways between them, without threads: what circulates never lets them come to rest."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection

from pebble.forwarding.forwarder import Forwarder
from pebble.forwarding.names import Names
from pebble.forwarding.routing import Rules, Side
from pebble.forwarding.subjects import Subjects
from pebble.transports import Message, QoS, State
from pebble.transports.memory import MemoryHub, MemoryTransport
from pebble.transports.topics import matches
from tests.services.mqtt_bridge.bridge_rig import BASE, is_probe, make_config

Receive = Callable[[Message], object]
_LAP_S = 0.001  # how long one message takes


class Network:
    """What is published and not delivered yet. Its clock advances with each delivery."""

    def __init__(self) -> None:
        self.now = 100.0
        self._due: deque[tuple[Receive, Message]] = deque()

    def clock(self) -> float:
        return self.now

    def deliver_later(self, receive: Receive, message: Message) -> None:
        self._due.append((receive, message))

    def rests_within(self, deliveries: int) -> bool:
        """Deliver until nothing is left; False if so many messages were not enough."""
        for _ in range(deliveries):
            if not self._due:
                return True
            self.now += _LAP_S
            receive, message = self._due.popleft()
            receive(message)
        return not self._due


class Node:
    """A broker; it sends no client its own messages."""

    def __init__(self, network: Network) -> None:
        self.network = network
        self._clients: dict[Client, tuple[Collection[str], Receive]] = {}

    def attach(self, client: Client, filters: Collection[str], receive: Receive) -> None:
        self._clients[client] = filters, receive

    def detach(self, client: Client) -> None:
        self._clients.pop(client, None)

    def distribute(self, message: Message, publisher: Client) -> None:
        for client, (filters, receive) in self._clients.items():
            if client is not publisher and any(matches(filter_, message.topic) for filter_ in filters):
                self.network.deliver_later(receive, message)


class Client(MemoryTransport):
    """One client of a :class:`Node`."""

    def __init__(self, node: Node) -> None:
        super().__init__("client", MemoryHub())
        self._node = node
        self.seen: list[Message] = []

    @property
    def state(self) -> State:
        return State.CONNECTED

    def listen(self, *filters: str, receive: Receive | None = None) -> Client:
        self._node.attach(self, filters, receive or self.seen.append)
        return self

    def leave(self) -> None:
        self._node.detach(self)

    def publish(
        self, topic: str, payload: bytes, *, qos: QoS = QoS.LATEST, retain: bool = False, **_options: bool
    ) -> bool:
        self._node.distribute(Message(topic, payload, qos, retain_requested=retain), self)
        return True

    def payloads(self, suffix: str) -> list[bytes]:
        """What has arrived on a topic, without probes."""
        return [m.payload for m in self.seen if m.topic == f"{BASE}/{suffix}" and not is_probe(m.payload)]


def bridge(
    local: Node, remote: Node, rules: Rules, *, mirroring: bool = False, names: Names | None = None
) -> Forwarder:
    """A bridge, or a mirror, that has just connected."""
    clients = {Side.LOCAL: Client(local), Side.REMOTE: Client(remote)}
    subjects, clock = Subjects(make_config()), local.network.clock
    forwarder = Forwarder(subjects, rules, dict(clients), winner=Side.REMOTE, names=names, clock=clock)
    forwarder.mirroring.switch(on=mirroring)
    leaving = (f"{BASE}/incoming/#", f"{BASE}/outgoing/#")
    entering = leaving[:1] if rules.leaves_robot else leaving
    for side, filters in ((Side.LOCAL, leaving), (Side.REMOTE, entering)):
        clients[side].listen(*filters, receive=lambda message, side=side: forwarder.receive(side, message))
        forwarder.subscribed(side)
    forwarder.open()
    for side in Side:
        forwarder.retained.synchronize(side)
    return forwarder


class Way:
    """Another way between two brokers: what it carries, and whether from the first to the second, back, or both."""

    def __init__(self, local: Node, remote: Node, direction: str, filter_: str) -> None:
        here, there = Client(local), Client(remote)
        self._clients = here, there
        if direction in ("out", "both"):
            here.listen(f"{BASE}/{filter_}", receive=_onto(there))
        if direction in ("in", "both"):
            there.listen(f"{BASE}/{filter_}", receive=_onto(here))

    def cut(self) -> None:
        for client in self._clients:
            client.leave()


def _onto(other: Client) -> Receive:
    return lambda message: other.publish(
        message.topic, message.payload, qos=message.qos, retain=bool(message.retain_requested)
    )
