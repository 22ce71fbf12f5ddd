"""What crosses a bridge or a mirror between real brokers and hubs: one table of messages, in every situation.

The same rules hold in virtual time (tests/forwarding/test_services.py). Each situation publishes the whole table from
both sides: QoS, retained or not, direction, known topic or not.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Final, NamedTuple
from zlib import crc32

import pytest

from pebble.forwarding.routing import MIRROR, TABLE_A1, Forward, route
from pebble.forwarding.subjects import Subjects
from pebble.transports import Message, QoS, State
from tests.forwarding.links.rig import LOCAL, REMOTE, End, MqttEnd, Rig, Side, ZenohEnd
from tests.services.mqtt_bridge.bridge_rig import Quiet
from tests.support import Broker, until

STOP = "incoming/estop"
LATEST_S = 20.0  # for what comes at once on a machine with nothing else to do
TRUE, PRESS = b'{"value": true}', b'{"stop": "00000000000000a1", "by": "test"}'

#: Topics by the side that publishes on them, within and outside of the contract.
TOPICS: Final[dict[Side, tuple[str, ...]]] = {
    LOCAL: (
        *("outgoing/navigation-goal", "outgoing/wheel-odometry", "outgoing/sensors/imu-fast", "outgoing/weather/local"),
        *("outgoing/media-report/one", "incoming/drive-values", "incoming/dance/local"),
        *("incoming/flags/mqtt-video", "incoming/flags/reboot", "incoming/flags/party-local"),
    ),
    REMOTE: (
        *("outgoing/diagnostics", "outgoing/apriltag-data", "outgoing/media-report/two", "outgoing/weather/remote"),
        *("incoming/lights-solid", STOP, "incoming/estop-reset", "incoming/dance/remote"),
        *("incoming/flags/mqtt-audio", "incoming/flags/git-pull", "incoming/flags/party-remote"),
    ),
}
RULES: Final = {"bridge": TABLE_A1, "mirror": MIRROR}
LINKS: dict[str, tuple[str, Callable[[Path], End], Callable[[Path], End]]] = {
    "bridge on 3.1.1": ("bridge", MqttEnd, MqttEnd),
    "mirror on 5": ("mirror", ZenohEnd, partial(MqttEnd, protocol="5")),
    "bridge on zenoh": ("bridge", ZenohEnd, partial(MqttEnd, protocol="5")),
    "bridge on 5": ("bridge", partial(MqttEnd, protocol="5"), partial(MqttEnd, protocol="5")),
    "mirror on 3.1.1": ("mirror", ZenohEnd, MqttEnd),
    "bridge to zenoh": ("bridge", MqttEnd, partial(ZenohEnd, uplink=True)),
}


class Cell(NamedTuple):
    """One cell of the table: a message on ``topic``, published by ``side``."""

    side: Side
    topic: str
    retain: bool
    qos: int

    def payload(self, situation: str) -> bytes:
        """A stop has a name: the bridge gives one to others, and so changes their bytes."""
        text = f"{situation}: QoS {self.qos}, {'retained' if self.retain else 'live'}"
        stop = f'{{"stop":"{crc32(text.encode()):016x}","why":"{text}"}}'
        return (stop if self.topic == STOP else text).encode()


TABLE: Final = [
    Cell(side, topic, retain, qos)
    for side in Side
    for topic, retain, qos in product(TOPICS[side], (False, True), (0, 1))
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

    def forward(self, cell: Cell) -> Forward | None:
        """Return how a cell passes, by the table of the service. A live stop that asks to be retained is one."""
        topic, retain = f"{self.base}/{cell.topic}", cell.retain and cell.topic != STOP
        subject = Subjects(self.config)[topic]
        message = Message(topic, b"{}", QoS(cell.qos), retain_requested=retain)
        found = route(RULES[self.name], cell.side, subject, message, mirroring=False)
        return found if isinstance(found, Forward) else None

    def expected(self, situation: str) -> Arrived:
        due: Arrived = {}
        for cell in TABLE:
            if (forward := self.forward(cell)) is not None:
                shape = cell.payload(situation), int(forward.qos), forward.retain
                due.setdefault(cell.topic, []).append(shape)
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
            arrive = [(topic, *shape) for topic in TOPICS[side.other] for shape in due.get(topic, ())]
            newest = {topic: payload for topic, payload, _, retain in arrive if retain}
            found = partial(self.retained_of_others, side)
            assert until(lambda found=found, newest=newest: found() == newest, LATEST_S), found()  # type: ignore[misc]

    def retained_of_others(self, side: Side) -> dict[str, bytes]:
        """What a late subscriber finds on ``side`` of what the other side has published."""
        return {topic: payload for topic, payload in self.retained(side).items() if topic in TOPICS[side.other]}


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


FIRST, _, _, *FURTHER = LINKS
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
def slow(end: End, delay_s: float) -> Iterator[None]:
    """The way to this broker is so meanwhile."""
    assert isinstance(end, MqttEnd)
    as_usual, end.link.delay_s = end.link.delay_s, delay_s
    yield
    end.link.delay_s = as_usual


@over(FIRST)
class TestBridge:
    def test_a_retained_stop_passes_on_no_slow_link(self, rig: TableRig) -> None:
        """A broker sends few retained messages at a time: the last ones arrive many round trips after the first."""
        others = 300
        for number in range(others):
            rig.remote.publish(f"incoming/flags/f{number}", TRUE, retain=True)
        rig.remote.publish(STOP, b"old", retain=True)
        with slow(rig.ends[REMOTE], 0.1):
            rig.start(ready=False)

            def arrived() -> int:
                return sum(number for name, number in rig.service.status.counts.items() if name.startswith("remote: "))

            assert until(lambda: arrived() >= others, 30)
            rig.wait_ready()
            rig.after_all(REMOTE)
            assert not rig.local.on(STOP)
            rig.remote.publish(STOP, PRESS)
            assert until(lambda: rig.local.payloads(STOP) == [PRESS])

    def test_a_frozen_remote_broker_does_not_delay_local_traffic(
        self, make: Callable[..., TableRig], tmp_path: Path
    ) -> None:
        code = f"open({str(tmp_path / 'ran')!r}, 'w')"
        rig = make(git_pull_control={"command": [sys.executable, "-c", code]})
        rig.start()
        other, broker = rig.client(LOCAL), rig.ends[REMOTE].broker
        assert isinstance(broker, Broker)
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
