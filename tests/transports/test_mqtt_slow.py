"""A connection over a slow way: patience, few pings, short queues."""

from __future__ import annotations

import os
import socket
from contextlib import closing, suppress
from pathlib import Path

import pytest

from pebble.transports import Message, MqttSettings, QoS, create
from pebble.transports.mqtt.ending import Silent
from tests.support import Broker, until
from tests.transports.received import Received
from tests.transports.test_mqtt_connection import Link, sent


@pytest.mark.parametrize(
    ("silence_s", "round_trip_s", "limit_s"), [(2.0, 0.0, 5.0), (20.0, 0.0, 20.0), (2.0, 0.9, 7.2)]
)
def test_the_limit(monkeypatch: pytest.MonkeyPatch, silence_s: float, round_trip_s: float, limit_s: float) -> None:
    with closing(Link(monkeypatch, silence_s, round_trip_s)) as link:
        link.connection.suit(thin=True)
        link.idle(limit_s - 0.2)
        with pytest.raises(Silent, match=f"has not answered for {limit_s} s"):
            link.idle(0.4)


def test_a_ping_at_least_every_second_and_a_half(monkeypatch: pytest.MonkeyPatch) -> None:
    with closing(Link(monkeypatch)) as link:
        link.connection.suit(thin=True)
        asked = 0
        for _ in range(200):
            link.idle(0.05)
            asked += link.answer_pings()
    assert 6 <= asked <= 10, "a little more, so that two are never a period"


def test_anything_is_a_sign_of_life(monkeypatch: pytest.MonkeyPatch) -> None:
    with closing(Link(monkeypatch)) as link:
        link.connection.suit(thin=True)
        for _ in range(20):
            link.idle(2.0)
            link.sends(sent(b"live"))
            link.pump()
        assert link.counters["silences"] == 0
        assert link.messages[-1].waited_s > 1.0, "which proves nothing about its age"


def test_how_long_an_answer_took_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    with closing(Link(monkeypatch)) as link:
        assert link.connection.answer is None
        link.idle(0.6)
        link.now += 0.3
        assert link.answer_pings() == 1
        first = link.connection.answer
        assert first is not None
        assert (first.number, first.queue_s is not None) == (1, True)
        assert 0.3 < first.seconds < 0.6
        assert first.delivered_s == pytest.approx(first.seconds, abs=0.05)
        assert first.late_s == pytest.approx(0.3, abs=0.2)
        link.idle(1.5)  # the next one is not answered
        second = link.connection.answer
        assert second is not None
        assert second.number == 1
        assert second.seconds > 0.9
        assert second.delivered_s > 1.5
        assert second.late_s > 0.7


def test_the_socket_keeps_little_while_the_way_is_slow(monkeypatch: pytest.MonkeyPatch) -> None:
    with closing(Link(monkeypatch)) as link:
        assert link.connection.socket is not None
        sizes = []
        for slow in (False, True, False):
            link.connection.suit(thin=slow)
            sizes.append(link.connection.socket.getsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT))
    assert sizes == [0, 4096, 0]


@pytest.mark.parametrize(("dscp", "tos"), [(0, 0), (46, 0xB8), (10, 0x28)])
def test_packets_are_marked(broker: Broker, dscp: int, tos: int) -> None:
    marks = []
    with create("mqtt", "client", MqttSettings(host="127.0.0.1", port=broker.port, dscp=dscp)):
        for link in list(Path("/proc/self/fd").iterdir()):
            with suppress(OSError, IndexError), socket.socket(fileno=os.dup(int(link.name))) as copy:
                if copy.getpeername()[1] == broker.port:
                    marks.append(copy.getsockopt(socket.IPPROTO_IP, socket.IP_TOS) & 0xFC)
    assert marks == [tos]


def test_a_connection_made_anew_publishes_no_will(broker: Broker) -> None:
    seen, wills, settings = Received(), Received(), MqttSettings(host="127.0.0.1", port=broker.port)
    will = Message("slow/online", b"offline", QoS.DELIVERED, retain=True)
    with create("mqtt", "robot", settings, will=will) as robot, create("mqtt", "operator", settings) as operator:
        robot.subscribe("slow/command", seen, direct=True)
        operator.subscribe(will.topic, wills, direct=True)
        count = robot.counters["connected"]
        robot.renew_connection("only late commands come")
        assert until(lambda: robot.counters["connected"] > count)
        operator.publish("slow/command", b"now", qos=QoS.DELIVERED)
        assert until(lambda: seen.messages)
        assert wills.messages == []
