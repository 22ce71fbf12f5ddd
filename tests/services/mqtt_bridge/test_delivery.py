"""What crosses the mirror and the bridge, as one table: QoS, retained or not, direction, known topic or not, outages.

Real mosquittos, reached by the service through a connection that can be cut, and a real Zenoh hub that can be killed.
One robot per link and kind of outage; each situation publishes the whole table from both sides.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import count, product
from pathlib import Path
from typing import Any, Final

import pytest

from pebble.config import Config, parse
from pebble.contract import Kind
from pebble.forwarding.routing import Side
from pebble.runtime.connections import local_transport
from pebble.services.mqtt_bridge.service import MqttBridge
from pebble.services.mqtt_mirror import MqttMirror
from pebble.transports import Message, MqttSettings, State, create
from tests.services.mqtt_bridge.bridge_rig import Client, Quiet, Running
from tests.support import Broker, until
from tests.tcp_proxy import TcpProxy
from tests.transports.zenoh_net import HubProcess

LOCAL, REMOTE = Side.LOCAL, Side.REMOTE
_numbers = count(1)

#: Topics of the contract by the side that publishes on them, and their kinds.
KNOWN: Final[dict[Side, dict[str, Kind]]] = {
    LOCAL: {
        "outgoing/navigation-goal": Kind.STATE,
        "outgoing/wheel-odometry": Kind.STREAM,
        "outgoing/sensors/imu-fast": Kind.STREAM,
        "outgoing/media-report/one": Kind.EVENT,
        "incoming/drive-values": Kind.COMMAND,
        "incoming/flags/mqtt-video": Kind.FLAG,
        "incoming/flags/reboot": Kind.ACTION,
    },
    REMOTE: {
        "outgoing/diagnostics": Kind.STATE,
        "outgoing/apriltag-data": Kind.STREAM,
        "outgoing/media-report/two": Kind.EVENT,
        "incoming/lights-solid": Kind.COMMAND,
        "incoming/flags/mqtt-audio": Kind.FLAG,
        "incoming/flags/git-pull": Kind.ACTION,
    },
}
#: Topics outside of the contract.
UNKNOWN: Final[dict[Side, dict[str, Kind]]] = {
    side: {
        f"outgoing/weather/{side.value}": Kind.EVENT,
        f"incoming/dance/{side.value}": Kind.COMMAND,
        f"incoming/flags/party-{side.value}": Kind.FLAG,
    }
    for side in Side
}
PASSES: Final = {
    "mirror": dict.fromkeys(Side, frozenset(Kind)),
    "bridge": {
        LOCAL: {Kind.STATE, Kind.EVENT, Kind.STREAM, Kind.FLAG, Kind.ACTION},
        REMOTE: {Kind.COMMAND, Kind.FLAG, Kind.ACTION},
    },
}
STAYS: Final = {"mirror": (), "bridge": ("outgoing/sensors/imu-fast", "outgoing/media-report/one")}


@dataclass(frozen=True)
class Cell:
    """One cell of the table: a message on ``topic``, published by ``side``."""

    side: Side
    topic: str
    kind: Kind
    retain: bool
    qos: int

    @property
    def known(self) -> bool:
        return self.topic in KNOWN[self.side]

    def passes(self, service: str) -> bool:
        """Commands and actions that are retained are stale."""
        once = self.kind in (Kind.COMMAND, Kind.ACTION)
        return (
            self.kind in PASSES[service][self.side] and self.topic not in STAYS[service] and not (once and self.retain)
        )

    @property
    def survives(self) -> bool:
        """Passes although the other side is away: the newest retained message of a topic, and events."""
        return self.qos == 1 and (self.retain or self.kind is Kind.EVENT)

    def payload(self, situation: str) -> bytes:
        return f"{situation}: QoS {self.qos}, {'retained' if self.retain else 'live'}".encode()

    def arrives(self, situation: str) -> tuple[bytes, int, bool]:
        """Same bytes; flags of the contract are always retained; to the robot with the channel's QoS at least."""
        to_robot = self.known and self.topic.startswith("incoming/")
        retained = self.retain or (self.known and self.kind is Kind.FLAG)
        return self.payload(situation), 1 if to_robot else self.qos, retained


TABLE: Final = [
    Cell(side, topic, kind, retain, qos)
    for side in Side
    for (topic, kind), retain, qos in product((KNOWN[side] | UNKNOWN[side]).items(), (False, True), (0, 1))
]
Arrived = dict[str, list[tuple[bytes, int, bool]]]


class End(ABC):
    """One side: a broker or a hub, which can be out of the service's reach."""

    survives: bool  # programs and service reach one another while it is away

    @abstractmethod
    def client(self, base: str) -> Client: ...

    @abstractmethod
    def leave(self) -> None: ...

    @abstractmethod
    def come_back(self) -> None: ...

    @abstractmethod
    def close(self) -> None: ...


class MqttEnd(End):
    survives = False

    def __init__(self, folder: Path) -> None:
        self._broker = Broker(folder)
        self._link = TcpProxy(self._broker.port)
        self.address: dict[str, Any] = {"host": "127.0.0.1", "port": self._link.port}

    def client(self, base: str) -> Client:
        settings = MqttSettings(host="127.0.0.1", port=self._broker.port, as_published=True)
        return Client(create("mqtt", f"{base}-{next(_numbers)}", settings), base)

    def leave(self) -> None:
        self._link.cut()

    def come_back(self) -> None:
        self._link.mend()

    def close(self) -> None:
        self._link.stop()
        self._broker.stop()


class ZenohEnd(End):
    survives = True

    def __init__(self, folder: Path) -> None:
        self._hub = HubProcess(folder / "run").start()
        # a machine that stands still for the usual two seconds would make live messages late, and they would be dropped
        self._settings = replace(self._hub.settings, lease_ms=5000)
        self.address = {"kind": "zenoh", "run_dir": str(self._settings.run_dir), "lease_ms": self._settings.lease_ms}

    def client(self, base: str) -> Client:
        return Client(create("zenoh", f"{base}-{next(_numbers)}", self._settings), base)

    def leave(self) -> None:
        self._hub.kill()

    def come_back(self) -> None:
        self._hub.start()

    def close(self) -> None:
        if self._hub.running:
            self._hub.end()


class Rig:
    """Both sides, a client on each, and the service in between."""

    def __init__(self, link: str, folder: Path) -> None:
        self.service, _, local = link.partition(" on ")
        remote_end = MqttEnd(folder)
        local_end = ZenohEnd(folder) if local == "zenoh" else MqttEnd(folder)
        self.ends: dict[Side, End] = {LOCAL: local_end, REMOTE: remote_end}
        self._config = self._parse(local_end.address, remote_end.address)
        self.clients = {side: end.client(self._config.base) for side, end in self.ends.items()}
        self._running: Running | None = None

    def start(self) -> None:
        if self.service == "mirror":
            local = local_transport(self._config, "mirror", as_published=True)
            self._instance: MqttMirror | MqttBridge = MqttMirror(self._config, local)
        else:
            local = local_transport(self._config, "local-bridge", as_published=True)
            self._instance = MqttBridge(self._config, local)
        self._running = Running(self._instance)

    @property
    def synchronized(self) -> bool:
        return self._instance.status.synchronized == {LOCAL, REMOTE}

    def is_synchronized(self, side: Side) -> bool:
        return side in self._instance.status.synchronized

    def state(self, side: Side) -> State:
        return {LOCAL: self._instance.transport, REMOTE: self._instance.remote}[side].state

    def publish_table(self, situation: str) -> None:
        for cell in TABLE:
            self.clients[cell.side].publish(cell.topic, cell.payload(situation), qos=cell.qos, retain=cell.retain)

    def arrived(self, situation: str) -> Arrived:
        """What came across, by topic."""
        came: Arrived = {}
        for message in (message for client in self.clients.values() for message in list(client.seen)):
            if message.payload.startswith(f"{situation}:".encode()):
                came.setdefault(message.topic.removeprefix(f"{self._config.base}/"), []).append(_shape(message))
        return came

    def expected(self, situation: str, away: End | None = None) -> Arrived:
        """The whole table, or what of it survives that ``away`` is away."""
        due: Arrived = {}
        for cell in TABLE:
            whole = away is None or away.survives
            # of what the clients of the absent side publish, the service finds retained copies
            lost = away is self.ends[cell.side] and not cell.retain
            if cell.passes(self.service) and (whole or (cell.survives and not lost)):
                due.setdefault(cell.topic, []).append(cell.arrives(situation))
        return due

    def retained(self, side: Side) -> dict[str, bytes]:
        """What a late subscriber finds on ``side`` of what the other side has published."""
        late = self.ends[side].client(self._config.base)
        Quiet(late).wait(0.2)
        late.transport.close()
        others = KNOWN[side.other] | UNKNOWN[side.other]
        found = {m.topic.removeprefix(f"{late.base}/"): m.payload for m in late.seen if m.retain}
        return {topic: payload for topic, payload in found.items() if topic in others}

    def close(self) -> None:
        if self._running is not None:
            self._running.stop()
        for client in self.clients.values():
            client.transport.close()
        for end in self.ends.values():
            end.close()

    def _parse(self, local: dict[str, Any], remote: dict[str, Any]) -> Config:
        raw: dict[str, Any] = {"robot": {"id": f"d{next(_numbers)}"}}
        if self.service == "mirror":  # beside a bridge, as on any robot: it looks first whether they share a broker
            raw["transport"] = {**local, "mqtt_mirror": remote}
            raw["services"] = {"mqtt_bridge": {"enabled": True, "remote_mqtt": {"host": "127.0.0.1"}}}
        else:
            raw["transport" if "kind" in local else "local_mqtt"] = local
            raw["services"] = {"mqtt_bridge": {"enabled": True, "remote_mqtt": remote}}
        return parse(raw, folder=Path.cwd(), env={})


def _shape(message: Message) -> tuple[bytes, int, bool]:
    return message.payload, int(message.qos), message.retain or bool(message.retain_requested)


@pytest.fixture(params=["mirror on zenoh", "bridge on zenoh", "bridge on mqtt"])
def rig(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Rig]:
    rig = Rig(request.param, tmp_path)
    yield rig
    rig.close()


def _by_quality(messages: Arrived) -> Arrived:
    """Each topic's messages of QoS 0, then those of QoS 1: between the two there is no order (T8)."""
    return {topic: sorted(each, key=lambda message: message[1]) for topic, each in messages.items()}


def crosses_once(rig: Rig, situation: str) -> None:
    """The whole table passes as published, each quality in order, once each, and what is retained can be found."""
    assert until(lambda: rig.synchronized)
    rig.publish_table(situation)
    due = rig.expected(situation)
    until(lambda: sum(map(len, rig.arrived(situation).values())) >= sum(map(len, due.values())), 5)
    Quiet(*rig.clients.values()).wait(0.1)
    assert _by_quality(rig.arrived(situation)) == _by_quality(due)
    for side in Side:
        cells = [cell for cell in TABLE if cell.side is side.other and cell.passes(rig.service)]
        newest = {cell.topic: cell.payload(situation) for cell in cells if cell.arrives(situation)[2]}
        assert until(lambda side=side, newest=newest: rig.retained(side) == newest, 3), rig.retained(side)


def crosses_later(rig: Rig, situation: str, away: Side) -> None:
    """What survives an outage has arrived (events of its beginning perhaps twice), and nothing else."""
    due = {topic: set(messages) for topic, messages in rig.expected(situation, rig.ends[away]).items()}

    def came() -> dict[str, set[tuple[bytes, int, bool]]]:
        return {topic: set(messages) for topic, messages in rig.arrived(situation).items()}

    until(lambda: came() == due, 5)
    assert until(lambda: rig.synchronized)
    Quiet(*rig.clients.values()).wait(0.1)
    assert came() == due


def test_both_sides_are_there(rig: Rig) -> None:
    rig.publish_table("before")
    rig.start()
    crosses_once(rig, "then")
    before = {topic: [message for message in messages if message[2]][-1:]
              for topic, messages in rig.expected("before").items()}  # fmt: skip
    assert {topic: messages[-1:] for topic, messages in rig.arrived("before").items()} == {
        topic: messages for topic, messages in before.items() if messages
    }


@pytest.mark.parametrize("away", [LOCAL, REMOTE], ids=lambda side: f"{side.value} away")
def test_one_side_is_away(rig: Rig, away: Side) -> None:
    end = rig.ends[away]
    end.leave()
    rig.start()
    # a bridge between two brokers subscribes only once it has seen both
    assert until(
        lambda: rig.is_synchronized(away.other) or (not end.survives and rig.state(away.other) is State.CONNECTED)
    )
    rig.publish_table("at the start")
    end.come_back()
    crosses_later(rig, "at the start", away)
    crosses_once(rig, "between")
    end.leave()
    assert until(lambda: rig.state(away) is State.CONNECTING)
    rig.publish_table("outage")
    end.come_back()
    crosses_later(rig, "outage", away)
    crosses_once(rig, "after")
