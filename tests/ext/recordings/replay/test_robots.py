"""The connections of a replay, on a memory hub."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator

import pytest

from pebble.errors import TransportError
from pebble.extensions.recordings.replay import robots as replayed_robots
from pebble.extensions.recordings.replay.robots import ReplayedRobots
from pebble.transports import Message, QoS
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.support import until

BASE = "replay/robots/goob"
ONLINE_TOPIC, LOGS = f"{BASE}/outgoing/online", f"{BASE}/outgoing/logs"


class Network:
    """A hub, another client of it, and all that this client receives."""

    def __init__(self) -> None:
        self.hub = MemoryHub()
        self.clients: list[MemoryTransport] = []
        self.received: list[Message] = []
        self.other = self.make("other", None).open()
        self.other.subscribe("#", self.received.append)

    def make(self, name: str, will: Message | None) -> MemoryTransport:
        self.clients.append(MemoryTransport(name, self.hub, will=will))
        return self.clients[-1]

    def robots(self, *bases: str) -> ReplayedRobots:
        return ReplayedRobots(self.make, bases or (BASE,), wall_ms=lambda: time.time_ns() // 10**6)

    def payloads(self, topic: str) -> list[bytes]:
        return [message.payload for message in list(self.received) if message.topic == topic]

    def states(self) -> list[object]:
        return [json.loads(payload).get("online") for payload in self.payloads(ONLINE_TOPIC)]


@pytest.fixture
def network() -> Iterator[Network]:
    network = Network()
    yield network
    for client in network.clients:
        client.close()


def heartbeat() -> Message:
    return Message(ONLINE_TOPIC, json.dumps({"t": time.time_ns() // 10**6}).encode(), QoS.DELIVERED)


def test_a_robot_is_offline_at_the_end_once_and_nothing_stays(network: Network) -> None:
    with network.robots() as robots:
        assert robots.publish(heartbeat())
        assert robots.publish(Message(LOGS, b"{}"))
    assert until(lambda: len(network.payloads(ONLINE_TOPIC)) == 2)
    assert network.states() == [None, False]
    assert json.loads(network.payloads(ONLINE_TOPIC)[-1])["t"] == pytest.approx(time.time() * 1000, abs=3000)
    assert network.hub.retained == {}


def test_each_robot_has_a_will(network: Network) -> None:
    with network.robots(BASE, "replay/robots/fred"):
        wills = [client.will for client in network.clients if client.will is not None]
        assert [(will.topic, json.loads(will.payload)["online"], will.retain) for will in wills] == [
            (ONLINE_TOPIC, False, False),
            ("replay/robots/fred/outgoing/online", False, False),
        ]
        network.hub.crash(next(client for client in network.clients if client.will is not None))
        assert until(lambda: network.states() == [False])


def test_without_a_broker_there_is_one_error(network: Network, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(replayed_robots, "OPEN_S", 0.05)
    network.hub.stop()
    with pytest.raises(TransportError, match="cannot connect: the hub is away"), network.robots():
        pass


def test_an_outage_is_named_until_it_ends(network: Network) -> None:
    with network.robots() as robots:
        network.hub.stop()
        assert until(lambda: not robots.publish(heartbeat()) and robots.problem.startswith("no connection"))
        network.hub.start()
        assert until(lambda: robots.publish(heartbeat()))
        assert robots.problem == ""
