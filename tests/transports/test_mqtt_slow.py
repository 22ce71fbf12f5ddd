"""A connection over a slow way: patience, short queues, and a beginning that asks only for what it has to know."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from pathlib import Path

import pytest

from pebble.transports import Message, MqttSettings, QoS, State, create
from pebble.transports.mqtt import packets
from pebble.transports.mqtt.ending import Silent
from pebble.transports.mqtt.transport import MqttTransport
from tests.support import Broker, until
from tests.tcp_proxy import TcpProxy
from tests.transports.received import Received
from tests.transports.test_mqtt_connection import PONG, Link, sent

PROOF, WILL = "slow/proof", "slow/online"
STATES = [f"slow/state/{number}" for number in range(40)]
ALL = list(range(40))


class TestPatience:
    @pytest.mark.parametrize(
        ("silence_s", "round_trip_s", "limit_s"), [(2.0, 0.0, 5.0), (20.0, 0.0, 20.0), (2.0, 0.9, 7.2)]
    )
    def test_the_limit(
        self, monkeypatch: pytest.MonkeyPatch, silence_s: float, round_trip_s: float, limit_s: float
    ) -> None:
        with closing(Link(monkeypatch, silence_s, round_trip_s)) as link:
            link.connection.suit(thin=True)
            link.idle(limit_s - 0.2)
            with pytest.raises(Silent, match=f"has not answered for {limit_s} s"):
                link.idle(0.4)

    def test_a_ping_at_least_every_second_and_a_half(self, monkeypatch: pytest.MonkeyPatch) -> None:
        with closing(Link(monkeypatch)) as link:
            link.connection.suit(thin=True)
            asked = 0
            for _ in range(200):
                link.idle(0.05)
                asked += link.answer_pings()
        assert 6 <= asked <= 10, "a little more, so that two are never a period"

    def test_a_ping_that_is_soon_due_goes_along_with_a_message(self, monkeypatch: pytest.MonkeyPatch) -> None:
        with closing(Link(monkeypatch)) as link:
            link.connection.suit(thin=True)
            written = []
            for _ in range(20):
                link.connection.publish(message("slow/online"))
                written.append(link.written())
                link.sends(PONG * written[-1].count(packets.PINGREQ))
                link.idle(0.25)
            pings = sum(one.endswith(packets.PINGREQ) for one in written)
            assert 5 <= pings <= 10
            assert b"".join(written).count(packets.PINGREQ) == pings
            assert packets.PINGREQ not in link.written(), "none of its own"

    def test_anything_is_a_sign_of_life(self, monkeypatch: pytest.MonkeyPatch) -> None:
        with closing(Link(monkeypatch)) as link:
            link.connection.suit(thin=True)
            for _ in range(20):
                link.idle(2.0)
                link.sends(sent(b"live"))
                link.pump()
            assert link.counters["silences"] == 0
            assert link.messages[-1].waited_s > 1.0, "which proves nothing about its age"

    def test_how_long_an_answer_took_is_known(self, monkeypatch: pytest.MonkeyPatch) -> None:
        with closing(Link(monkeypatch)) as link:
            assert link.connection.answer is None
            link.idle(0.6)
            link.now += 0.3
            assert link.answer_pings() == 1
            first = link.connection.answer
            assert first is not None
            assert (first.number, first.queue_s is not None) == (1, True)
            assert 0.3 < first.seconds < 0.6
            assert (first.delivered_s, first.late_s) == (
                pytest.approx(first.seconds, abs=0.05),
                pytest.approx(0.3, abs=0.2),
            )
            link.idle(1.5)  # the next one is not answered
            second = link.connection.answer
            assert second is not None
            assert second.number == 1
            assert second.seconds > 0.9
            assert second.delivered_s > 1.5
            assert second.late_s > 0.7


class TestSocket:
    def test_keeps_little_while_the_way_is_slow(self, monkeypatch: pytest.MonkeyPatch) -> None:
        with closing(Link(monkeypatch)) as link:
            assert link.connection.socket is not None
            sizes = []
            for slow in (False, True, False):
                link.connection.suit(thin=slow)
                sizes.append(link.connection.socket.getsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT))
        assert sizes == [0, 4096, 0]

    @pytest.mark.parametrize(("dscp", "tos"), [(0, 0), (46, 0xB8), (10, 0x28)])
    def test_marks_packets(self, broker: Broker, dscp: int, tos: int) -> None:
        settings = MqttSettings(host="127.0.0.1", port=broker.port, dscp=dscp)
        with closing(create("mqtt", "client", settings).open(10)) as transport:
            assert isinstance(transport, MqttTransport)
            assert transport.state is State.CONNECTED
            assert _marks(broker.port) == [tos]


def _marks(port: int) -> list[int]:
    """How this process's connections to ``port`` mark their packets."""
    found = []
    for link in list(Path("/proc/self/fd").iterdir()):
        with suppress(OSError, IndexError), socket.socket(fileno=os.dup(int(link.name))) as copy:
            if copy.getpeername()[1] == port:
                found.append(copy.getsockopt(socket.IPPROTO_IP, socket.IP_TOS) & 0xFC)
    return found


def message(topic: str, payload: bytes = b"x") -> Message:
    return Message(topic, payload, QoS.DELIVERED, retain=True)


class Recorder(TcpProxy):
    """Keeps what clients send."""

    def __init__(self, target: int) -> None:
        self.sent = bytearray()
        super().__init__(target)

    def passes(self, data: bytes) -> bool:
        self.sent += data
        return True


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    broker = Broker(tmp_path, persistence=True, autosave=False)
    yield broker
    broker.stop()


class Robot:
    """Forty states and a proof at a broker behind a proxy."""

    def __init__(self, broker: Broker, proxy: Recorder, *, slow: bool = True) -> None:
        self.proxy = proxy
        settings = MqttSettings(host="127.0.0.1", port=proxy.port, reconnect_max_s=0.1)
        self.transport = create("mqtt", "robot", settings, will=message(WILL, b"offline"))
        self.transport.suit_link(thin=slow)
        self.transport.open(10)
        for topic in STATES:
            self.publish(topic, b"old")
        self.publish(PROOF, b"1")
        self.publish(PROOF, b"2")
        self.confirm()

    def publish(self, topic: str, payload: bytes) -> None:
        assert self.transport.publish(topic, payload, qos=QoS.DELIVERED, retain=True)

    def confirm(self) -> None:
        """Wait until the broker has answered all that was published: its answer to this comes after those."""
        self.transport.ask([PROOF])

    def reconnects(self, meanwhile: Callable[[], object] = lambda: None) -> list[int]:
        """Lose the connection; returns for which states the next one asks, or which it sends."""
        count = self.transport.counters["connected"]
        self.proxy.cut()
        assert until(lambda: self.transport.state is State.CONNECTING)
        meanwhile()
        self.proxy.sent.clear()
        self.proxy.mend()
        assert until(lambda: self.transport.counters["connected"] > count)
        read = -1
        while read != len(self.proxy.sent):  # what it sends at once may be on its way still
            read = len(self.proxy.sent)
            time.sleep(0.1)
        return [number for number in range(40) if b"slow/state/%d\0" % number in self.proxy.sent]


@pytest.fixture
def recorder(broker: Broker) -> Iterator[Recorder]:
    with Recorder(broker.port) as recorder:
        yield recorder


def values(broker: Broker) -> dict[str, bytes]:
    """What the broker has retained."""
    received = Received()
    with create("mqtt", "reader", MqttSettings(host="127.0.0.1", port=broker.port)) as reader:
        reader.subscribe("slow/#", received, direct=True)
        return {one.topic: one.payload for one in received.messages}


def test_a_connection_made_anew_publishes_no_will(broker: Broker, recorder: Recorder) -> None:
    robot, seen, wills = Robot(broker, recorder), Received(), Received()
    robot.transport.subscribe("slow/command", seen, direct=True)
    with create("mqtt", "operator", MqttSettings(host="127.0.0.1", port=broker.port)) as operator:
        operator.subscribe(WILL, wills, direct=True)
        count = robot.transport.counters["connected"]
        robot.transport.renew_connection("only late commands come")
        assert until(lambda: robot.transport.counters["connected"] > count)
        operator.publish("slow/command", b"now", qos=QoS.DELIVERED)
        assert until(lambda: seen.messages)
        assert wills.messages == []
    robot.transport.close()
