"""The connections of a replay, on a memory hub: it publishes nothing in the name of a live robot."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from pebble.config import parse
from pebble.contract import ONLINE
from pebble.errors import TransportError
from pebble.recordings.replay import live
from pebble.recordings.replay import robots as replayed_robots
from pebble.recordings.replay.robots import ReplayedRobots
from pebble.recordings.replay.rules import ReplayError, zero
from pebble.runtime.addresses import Addresses
from pebble.services.mqtt_bridge.heartbeat import Heartbeat as BridgeHeartbeat
from pebble.transports import Message, QoS, State, Transport
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.recordings.playing import GOOB, Line, js, ms, write
from tests.recordings.replayed import Plays
from tests.support import until

BASE = "replay/robots/goob"
ONLINE_TOPIC, LOGS, STATUS = f"{BASE}/outgoing/online", f"{BASE}/outgoing/logs", f"{BASE}/outgoing/status"


class Network:
    """A hub, another client of it, and all that this client receives."""

    def __init__(self) -> None:
        self.hub = MemoryHub()
        self.clients: list[MemoryTransport] = []
        self.received: list[Message] = []
        self.wait: Callable[[float], Any] = time.sleep
        self.other = self.make("other", None).open()
        self.other.subscribe("#", self.received.append)

    def make(self, name: str, will: Message | None) -> MemoryTransport:
        self.clients.append(MemoryTransport(name, self.hub, will=will))
        return self.clients[-1]

    def robots(self, *bases: str) -> ReplayedRobots:
        return ReplayedRobots(
            self.make,
            bases or (BASE,),
            now=time.monotonic,
            wall_ms=lambda: time.time_ns() // 10**6,
            wait=lambda seconds: self.wait(seconds),
        )

    def robot(self) -> MemoryTransport:
        return next(client for client in self.clients if client.will is not None)

    def payloads(self, topic: str) -> list[bytes]:
        return [message.payload for message in list(self.received) if message.topic == topic]

    def states(self) -> list[object]:
        return [json.loads(payload).get("online") for payload in self.payloads(ONLINE_TOPIC)]


@pytest.fixture
def network(monkeypatch: pytest.MonkeyPatch) -> Iterator[Network]:
    monkeypatch.setattr(live, "silent_after", lambda **_: 0.15)
    monkeypatch.setattr(replayed_robots, "CLEAR_S", 0.5)
    network = Network()
    yield network
    for client in network.clients:
        client.close()


def heartbeat(**fields: object) -> Message:
    return Message(ONLINE_TOPIC, json.dumps({"t": time.time_ns() // 10**6, **fields}).encode(), QoS.DELIVERED)


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
        network.hub.crash(network.robot())
        assert until(lambda: network.states() == [False])


@pytest.mark.parametrize(
    ("topic", "payload"),
    [
        (ONLINE_TOPIC, b'{"t":1}'),
        (f"{BASE}/outgoing/heartbeat", b'{"t":1}'),
        (LOGS, b"{}"),
        (f"{BASE}/outgoing/touch-sensors", b"{}"),
    ],
)
def test_rule_3_it_refuses_to_begin_while_that_robot_publishes_anything(
    network: Network, topic: str, payload: bytes
) -> None:
    robots = network.robots()
    network.wait = lambda seconds: (network.other.publish(topic, payload), time.sleep(seconds))[1]
    with pytest.raises(ReplayError, match="replay/robots/goob is live: switch it off"), robots:
        pass
    assert until(lambda: network.payloads(topic))
    assert False not in network.states()


def test_rule_3_what_is_old_or_offline_is_no_robot(network: Network) -> None:
    network.other.publish(ONLINE_TOPIC, b'{"t":1}', qos=QoS.DELIVERED, retain=True)
    network.other.publish(STATUS, b'{"value":{}}', qos=QoS.DELIVERED, retain=True)
    robots = network.robots()
    network.wait = lambda seconds: (
        network.other.publish(ONLINE_TOPIC, b'{"online":false,"t":1}'),
        network.other.publish(ONLINE_TOPIC, b"nonsense"),
        network.other.publish(STATUS, b"", retain=True),
        network.other.publish("replay/robots/fred/outgoing/online", b'{"t":1}'),
        network.other.publish(f"{BASE}/incoming/drive-values", b"{}"),
        time.sleep(seconds),
    )[-1]
    with robots:
        assert robots.publish(Message(LOGS, b"{}"))


@pytest.mark.parametrize("channel", ["online", "heartbeat", "status", "capabilities"])
def test_rule_3_it_ends_when_that_robot_comes_online(network: Network, channel: str) -> None:
    with network.robots() as robots:
        assert robots.publish(heartbeat())
        network.other.publish(f"{BASE}/outgoing/{channel}", js(t=ms(5), value={}))
        assert until(lambda: robots.live)
        assert robots.publish(zero(f"{BASE}/incoming/drive-values"))  # always
        with pytest.raises(ReplayError, match="is live: the replay has ended"):
            robots.publish(heartbeat())
        with pytest.raises(ReplayError, match="is live: the replay has ended"):
            robots.check()
    assert False not in network.states()  # the live robot publishes its own


def test_rule_3_a_bridge_that_starts_is_noticed_at_its_first_heartbeat(network: Network) -> None:
    config = parse({"robot": {"id": "goob", "system": "replay"}}, folder=Path(), env={})
    bridge = BridgeHeartbeat(Addresses(config)[ONLINE])
    with network.robots() as robots:
        bridge.publish(network.other, time.time_ns() // 10**6)
        assert until(lambda: robots.live)
        with pytest.raises(ReplayError, match="is live"):
            robots.check()


def test_rule_3_own_messages_are_no_other_robot(network: Network) -> None:
    with network.robots() as robots:
        for number in range(100):
            for topic in (ONLINE_TOPIC, STATUS, f"{BASE}/outgoing/capabilities"):
                assert robots.publish(Message(topic, js(t=number, value={})))
        assert until(lambda: len(network.received) == 300)
        robots.check()


def test_a_refused_subscription_ends_it(network: Network, monkeypatch: pytest.MonkeyPatch) -> None:
    subscribe = Transport.subscribe

    def refused(*arguments: object, **more: object) -> object:
        subscription = subscribe(*arguments, **more)  # type: ignore[arg-type]
        subscription.refused = True
        return subscription

    monkeypatch.setattr(Transport, "subscribe", refused)
    with pytest.raises(ReplayError, match="would not be noticed"), network.robots():
        pass


def test_without_a_broker_there_is_one_error(network: Network, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(replayed_robots, "OPEN_S", 0.05)
    network.hub.stop()
    with pytest.raises(TransportError, match="cannot connect: the hub is away"), network.robots():
        pass


# -- rule 5


def test_rule_5_what_is_retained_is_removed_at_the_end(network: Network) -> None:
    retained = Message(STATUS, b"{}", QoS.DELIVERED, retain=True)
    with network.robots() as robots:
        assert robots.publish(retained)
        assert robots.publish(Message(f"{BASE}/outgoing/gone", b"1", QoS.DELIVERED, retain=True))
        assert robots.publish(Message(f"{BASE}/outgoing/gone", b"", QoS.DELIVERED, retain=True))
        assert list(network.hub.retained) == [STATUS]
        network.wait = lambda _seconds: time.sleep(0.1)
    assert network.hub.retained == {}
    assert until(lambda: network.states() == [False])


def test_rule_5_also_after_an_error(network: Network) -> None:
    def play() -> None:
        with network.robots() as robots:
            robots.publish(Message(STATUS, b"{}", QoS.DELIVERED, retain=True))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        play()
    assert network.hub.retained == {}
    assert until(lambda: network.states() == [False])


def test_rule_5_what_was_retained_before_is_neither_replaced_nor_removed(network: Network) -> None:
    network.other.publish(STATUS, b"theirs", qos=QoS.DELIVERED, retain=True)
    with network.robots() as robots:
        assert robots.publish(Message(STATUS, b"{}", QoS.DELIVERED, retain=True))
    assert network.hub.retained[STATUS].payload == b"theirs"


def test_rule_5_a_connection_that_is_lost_at_the_end_is_waited_for(network: Network) -> None:
    with network.robots() as robots:
        robots.publish(Message(STATUS, b"{}", QoS.DELIVERED, retain=True))
        network.hub.stop()
        network.wait = lambda _seconds: network.hub.start() if network.hub.era is None else time.sleep(0.01)
    assert network.hub.retained == {}


def test_rule_5_what_cannot_be_removed_is_named(network: Network) -> None:
    def play() -> None:
        with network.robots() as robots:
            robots.publish(Message(STATUS, b"{}", QoS.DELIVERED, retain=True))
            network.hub.stop()

    with pytest.raises(ReplayError, match=f"still retained, because the connection is lost: {STATUS}"):
        play()


def test_nothing_is_sent_to_a_broker_that_comes_back_empty(network: Network) -> None:
    with network.robots() as robots:
        robots.publish(Message(STATUS, b"{}", QoS.DELIVERED, retain=True))
        network.hub.stop(forget=True)
        network.hub.start()
        assert until(lambda: network.robot().state is State.CONNECTED)
        assert network.hub.retained == {}


def test_after_an_outage_it_listens_again(network: Network) -> None:
    with network.robots() as robots:
        network.hub.stop()
        assert until(lambda: not robots.publish(heartbeat()) and robots.problem.startswith("no connection"))
        network.hub.start()
        began = time.monotonic()
        assert until(lambda: robots.publish(heartbeat()))
        assert time.monotonic() - began > 0.14
        assert robots.problem == ""


# -- a recording as the robot of a service under test


def test_the_fixture_feeds_a_recording_to_the_clients_of_a_hub(tmp_path: Path, recording: Plays) -> None:
    hub, received = MemoryHub(), []
    lines = [
        Line(0, f"{GOOB}/outgoing/status", js(t=ms(0)), 1, retain=True),
        *(Line(n / 50, f"{GOOB}/incoming/drive-values", js(x=n / 3000, z=0), 1) for n in range(3000)),
    ]
    path = write(tmp_path / "x.mcap", lines)
    with MemoryTransport("service", hub) as service:
        service.subscribe(f"{GOOB}/incoming/#", received.append, direct=True)
        began = time.perf_counter()
        player = recording([path], hub)
        assert time.perf_counter() - began < 30, "a second on a machine that is not busy; the recording takes 60"
        assert until(lambda: len(received) == 3001)
    assert player.sent == 3001
    assert [message.payload for message in received] == [*(line.payload for line in lines[1:]), zero("").payload]
    assert list(hub.retained) == [f"{GOOB}/outgoing/status"]
