"""What crosses a bridge or a mirror between real brokers and hubs: one table of messages, in every situation.

The same rules hold in virtual time (tests/forwarding/test_services.py). Each situation publishes the whole table from
both sides: QoS, retained or not, direction, known topic or not.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Final
from zlib import crc32

import pytest

from pebble.contract import Kind
from pebble.forwarding.side import Gate
from pebble.transports import Message, State
from tests.forwarding.links.rig import LOCAL, REMOTE, End, MqttEnd, Rig, Side, ZenohEnd
from tests.services.mqtt_bridge.bridge_rig import Quiet
from tests.support import Broker, until
from tests.tcp_proxy import TcpProxy

STOP, RESET, DRIVE = "incoming/estop", "incoming/estop-reset", "incoming/drive-values"
VIDEO_FLAG, AUDIO_FLAG = "incoming/flags/mqtt-video", "incoming/flags/mqtt-audio"
MIRROR_FLAG = "incoming/flags/remote-mirror"
LATEST_S = 20.0  # for what comes at once on a machine with nothing else to do
TRUE, FALSE, PRESS = b'{"value": true}', b'{"value": false}', b'{"stop": "00000000000000a1", "by": "test"}'

#: Topics of the contract by the side that publishes on them, and their kinds.
KNOWN: Final[dict[Side, dict[str, Kind]]] = {
    LOCAL: {
        "outgoing/navigation-goal": Kind.STATE,
        "outgoing/wheel-odometry": Kind.STREAM,
        "outgoing/sensors/imu-fast": Kind.STREAM,
        "outgoing/media-report/one": Kind.EVENT,
        DRIVE: Kind.COMMAND,
        VIDEO_FLAG: Kind.FLAG,
        "incoming/flags/reboot": Kind.ACTION,
    },
    REMOTE: {
        "outgoing/diagnostics": Kind.STATE,
        "outgoing/apriltag-data": Kind.STREAM,
        "outgoing/media-report/two": Kind.EVENT,
        "incoming/lights-solid": Kind.COMMAND,
        STOP: Kind.COMMAND,
        RESET: Kind.COMMAND,
        AUDIO_FLAG: Kind.FLAG,
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
LINKS: dict[str, tuple[str, Callable[[Path], End], Callable[[Path], End]]] = {
    "bridge on 3.1.1": ("bridge", MqttEnd, MqttEnd),
    "mirror on 5": ("mirror", ZenohEnd, partial(MqttEnd, protocol="5")),
    "bridge on zenoh": ("bridge", ZenohEnd, partial(MqttEnd, protocol="5")),
    "bridge on 5": ("bridge", partial(MqttEnd, protocol="5"), partial(MqttEnd, protocol="5")),
    "mirror on 3.1.1": ("mirror", ZenohEnd, MqttEnd),
    "bridge to zenoh": ("bridge", MqttEnd, partial(ZenohEnd, uplink=True)),
}


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
        """Commands and actions that ask to be retained are stale, but a live stop is one."""
        once = self.kind in (Kind.COMMAND, Kind.ACTION) and self.topic != STOP
        return (
            self.kind in PASSES[service][self.side] and self.topic not in STAYS[service] and not (once and self.retain)
        )

    def payload(self, situation: str) -> bytes:
        """A stop has a name: the bridge gives one to others, and so changes their bytes."""
        text = f"{situation}: QoS {self.qos}, {'retained' if self.retain else 'live'}"
        stop = f'{{"stop":"{crc32(text.encode()):016x}","why":"{text}"}}'
        return (stop if self.topic == STOP else text).encode()

    def arrives(self, situation: str) -> tuple[bytes, int, bool]:
        """Same bytes; flags of the contract are always retained; to the robot with the channel's QoS at least."""
        to_robot = self.known and self.topic.startswith("incoming/")
        retained = (self.retain and self.topic != STOP) or (self.known and self.kind is Kind.FLAG)
        return self.payload(situation), 1 if to_robot else self.qos, retained


TABLE: Final = [
    Cell(side, topic, kind, retain, qos)
    for side in Side
    for (topic, kind), retain, qos in product((KNOWN[side] | UNKNOWN[side]).items(), (False, True), (0, 1))
]
Arrived = dict[str, list[tuple[bytes, int, bool]]]


class TableRig(Rig):
    """Publishes the table, and knows what of it is due."""

    def publish_table(self, situation: str) -> None:
        for cell in TABLE:
            self.clients[cell.side].publish(cell.topic, cell.payload(situation), qos=cell.qos, retain=cell.retain)

    def arrived(self, situation: str) -> Arrived:
        """What came across, by topic."""
        came: Arrived = {}
        for message in (message for client in self.clients.values() for message in list(client.seen)):
            if f"{situation}: ".encode() in message.payload:
                came.setdefault(message.topic.removeprefix(f"{self.base}/"), []).append(_shape(message))
        return came

    def expected(self, situation: str) -> Arrived:
        due: Arrived = {}
        for cell in TABLE:
            if cell.passes(self.name):
                due.setdefault(cell.topic, []).append(cell.arrives(situation))
        return due

    def crosses_once(self, situation: str) -> None:
        """The whole table passes as published, each quality in order, once each, and what is retained can be found."""
        assert until(lambda: self.synchronized)
        self.publish_table(situation)
        due = self.expected(situation)
        until(lambda: sum(map(len, self.arrived(situation).values())) >= sum(map(len, due.values())), LATEST_S)
        Quiet(*self.clients.values()).wait(0.1)
        assert _by_quality(self.arrived(situation)) == _by_quality(due)
        for side in Side:
            cells = [cell for cell in TABLE if cell.side is side.other and cell.passes(self.name)]
            newest = {cell.topic: cell.payload(situation) for cell in cells if cell.arrives(situation)[2]}
            found = partial(self.retained_of_others, side)
            assert until(lambda found=found, newest=newest: found() == newest, LATEST_S), found()  # type: ignore[misc]

    def retained_of_others(self, side: Side) -> dict[str, bytes]:
        """What a late subscriber finds on ``side`` of what the other side has published."""
        others = KNOWN[side.other] | UNKNOWN[side.other]
        return {topic: payload for topic, payload in self.retained(side).items() if topic in others}


def _shape(message: Message) -> tuple[bytes, int, bool]:
    return message.payload, int(message.qos), message.retain or bool(message.retain_requested)


def _by_quality(messages: Arrived) -> Arrived:
    """Each topic's messages of QoS 0, then those of QoS 1: between the two there is no order (T8)."""
    return {topic: sorted(each, key=lambda message: message[1]) for topic, each in messages.items()}


@pytest.fixture(scope="module")
def ends(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, End, End]]:
    """A link: the service's name, and both ends, which the tests of this file share."""
    service, *kinds = LINKS[request.param]
    local, remote = (kind(tmp_path_factory.mktemp("end")) for kind in kinds)
    yield service, local, remote
    for end in (local, remote):
        end.close()


@pytest.fixture
def make(ends: tuple[str, End, End]) -> Iterator[Callable[..., TableRig]]:
    """Makes rigs on the link, each with a robot of its own."""
    made: list[TableRig] = []

    def make(**section: Any) -> TableRig:
        made.append(TableRig(*ends, **section))
        return made[-1]

    yield make
    for rig in made:
        rig.close()


@pytest.fixture
def rig(make: Callable[..., TableRig]) -> TableRig:
    return make()


def over(*names: Any) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("ends", names, indirect=True)


FIRST, SECOND, _, *FURTHER = LINKS
MARKS = {name: [pytest.mark.thorough] for name in FURTHER}
each_link = over(*(pytest.param(name, marks=MARKS.get(name, ())) for name in LINKS))


@each_link
def test_both_sides_are_there(rig: TableRig) -> None:
    rig.publish_table("before")
    rig.start()
    rig.crosses_once("then")
    before = {topic: [message for message in messages if message[2]][-1:]
              for topic, messages in rig.expected("before").items()}  # fmt: skip
    assert {topic: messages[-1:] for topic, messages in rig.arrived("before").items()} == {
        topic: messages for topic, messages in before.items() if messages
    }


@contextmanager
def slow(rig: Rig, delay_s: float) -> Iterator[None]:
    """The way to the operators' broker is so meanwhile."""
    link = link_of(rig)
    as_usual, link.delay_s = link.delay_s, delay_s
    yield
    link.delay_s = as_usual


def link_of(rig: Rig) -> TcpProxy:
    end = rig.ends[REMOTE]
    assert isinstance(end, MqttEnd)
    return end.link


def broker_of(rig: Rig) -> Broker:
    end = rig.ends[REMOTE]
    assert isinstance(end, MqttEnd)
    assert isinstance(end.broker, Broker)
    return end.broker


@over(FIRST)
class TestBridge:
    def test_a_retained_stop_passes_on_no_slow_link(self, rig: TableRig) -> None:
        """A broker sends few retained messages at a time: the last ones arrive many round trips after the first."""
        others = 300
        for number in range(others):
            rig.remote.publish(f"incoming/flags/f{number}", TRUE, retain=True)
        rig.remote.publish(STOP, b"old", retain=True)
        with slow(rig, 0.1):
            rig.start(ready=False)

            def arrived() -> int:
                return sum(number for name, number in rig.service.status.counts.items() if name.startswith("remote: "))

            assert until(lambda: arrived() >= others, 30)
            rig.wait_ready()
            rig.after_all(REMOTE)
            assert not rig.local.on(STOP)
            rig.remote.publish(STOP, PRESS)
            assert until(lambda: rig.local.payloads(STOP) == [PRESS])

    def test_a_stop_that_a_new_subscription_brings_does_not_pass(self, rig: TableRig) -> None:
        """After the gate was shut the bridge subscribes anew, on connections that have been up for long."""
        bridge = rig.start()
        for client in (rig.local, rig.remote):
            client.publish(STOP, PRESS, retain=True)
        rig.local.publish(MIRROR_FLAG, TRUE, retain=True)
        assert until(lambda: rig.local.on(STOP) and bridge.status.mirroring)
        bridge.forwarder.shut()
        bridge.post(bridge.found_one_broker)
        bridge.post(partial(bridge.check_again, bridge.status.epoch))
        assert until(lambda: rig.gate is Gate.OPEN and REMOTE in bridge.status.subscribed)
        rig.after_all(REMOTE)
        rig.after_all(LOCAL)
        assert rig.local.payloads(STOP) == [PRESS]  # the live one
        assert not rig.remote.on(STOP)

    def test_a_frozen_remote_broker_does_not_delay_local_traffic(
        self, make: Callable[..., TableRig], tmp_path: Path
    ) -> None:
        code = f"open({str(tmp_path / 'ran')!r}, 'w')"
        rig = make(git_pull_control={"command": [sys.executable, "-c", code]})
        rig.start()
        other, broker = rig.client(LOCAL), broker_of(rig)
        broker.freeze()
        for number in range(400):  # together fewer than the 1000 that mosquitto holds for a slow reader
            rig.local.publish("outgoing/status", b"%d " % number + bytes(2000), retain=True)
            rig.local.publish("outgoing/touch-sensors", b"%d" % number)
        assert until(lambda: len(other.on("outgoing/touch-sensors")) == 400, LATEST_S)
        rig.local.publish("incoming/flags/git-pull", b"true")
        assert until(lambda: (tmp_path / "ran").exists(), LATEST_S)
        assert until(lambda: rig.service.remote.state is State.CONNECTING, LATEST_S)
        broker.thaw()
        assert until(lambda: rig.retained(REMOTE).get("outgoing/status", b"").startswith(b"399 "), LATEST_S, step=0.3)
