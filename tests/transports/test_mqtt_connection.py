"""A connection against the other end of its socket, which does what no broker does on demand; time is virtual."""

from __future__ import annotations

import os
import select
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import closing, nullcontext, suppress
from pathlib import Path

import pytest

from pebble.transports import Message, MqttSettings, QoS, clock, create
from pebble.transports.counters import Counters
from pebble.transports.hosts import addresses_of
from pebble.transports.mqtt import packets
from pebble.transports.mqtt.broker_limits import Limits
from pebble.transports.mqtt.client import Opening
from pebble.transports.mqtt.connection import Connection
from pebble.transports.mqtt.ending import Lost, Silent
from pebble.transports.mqtt.packets import Filter
from pebble.transports.mqtt.transport import MqttTransport
from tests.kit.mqtt_bytes import packet, publish
from tests.support import WAIT_S, Broker, until
from tests.transports.net import Received

PONG = packet(0xD0, b"")


def sent(payload: bytes, *, topic: str = "a", retain: bool = False, mid: int = 0) -> bytes:
    """Return a PUBLISH; of QoS 1 with an id."""
    return publish(topic, payload, int(mid > 0), mid, retain=retain)


class Link:
    """A connection that is accepted after ``round_trip_s``, its messages, and the other end."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, silence_s: float = 2.0, round_trip_s: float = 0.0) -> None:
        self.now = 1000.0
        monkeypatch.setattr(clock, "since_boot", lambda: self.now)
        self.messages: list[Message] = []
        with socket.create_server(("127.0.0.1", 0)) as server:
            settings = MqttSettings(host="127.0.0.1", port=server.getsockname()[1], silence_s=silence_s)
            self.owner = MqttTransport("client", settings)
            opening = Opening("client", settings, None, None, addresses_of(settings.host, settings.port)[0])
            self.counters = Counters()
            self.connection = Connection(opening, self.counters, self.owner, where="broker", as_published=False)
            connecting = threading.Thread(target=self.connection.connect, args=(threading.Event(),))
            connecting.start()
            self.other, _ = server.accept()
        self.other.settimeout(5)
        assert self.other.recv(4096).startswith(b"\x10")
        assert until(lambda: not self.connection.dialling)  # from then on it waits for the answer
        self.now += round_trip_s
        self.other.sendall(b"\x20\2\0\0")
        connecting.join(WAIT_S)

    def sends(self, *data: bytes) -> None:
        """The other end does; all of it is in our socket when this returns."""
        if whole := b"".join(data):
            self.other.sendall(whole)
            select.select([self.connection.client.socket], [], [], 5)

    def pump(self, *, until_read: int = 1) -> None:
        """Go on until so many messages are read."""
        wanted = len(self.messages) + until_read
        while len(self.messages) < wanted:
            self.connection.pump(1.0, self.messages.extend)

    def idle(self, seconds: float) -> None:
        """Let so much time pass, in which `pump` is called and nothing comes."""
        for _ in range(round(seconds / 0.05)):
            self.now += 0.05
            self.connection.pump(0.0, self.messages.extend)

    def written(self) -> bytes:
        """What the other end has received."""
        parts = []
        while select.select([self.other], [], [], 0.005)[0]:
            parts.append(self.other.recv(1 << 20))
        return b"".join(parts)

    def answer_pings(self) -> int:
        """Returns how many there were."""
        if asked := self.written().count(packets.PINGREQ):
            self.sends(PONG * asked)
            self.connection.pump(0.0, self.messages.extend)
        return asked

    def close(self) -> None:
        self.connection.discard()
        self.other.close()


@pytest.fixture
def link(monkeypatch: pytest.MonkeyPatch) -> Iterator[Link]:
    link = Link(monkeypatch)
    yield link
    link.close()


@pytest.mark.parametrize("fails", [False, True])
def test_a_message_is_acknowledged_when_it_was_handled_even_if_that_failed(link: Link, fails: bool) -> None:
    handled: list[bytes] = []

    def handle(messages: list[Message]) -> None:
        handled.extend(message.payload for message in messages)
        assert not select.select([link.other], [], [], 0.1)[0], "acknowledged before"
        if fails:
            raise RuntimeError("a handler failed")

    link.sends(sent(b"x", mid=1), sent(b"x", mid=2))
    with pytest.raises(RuntimeError) if fails else nullcontext():
        while not handled:
            link.connection.pump(1.0, handle)
    assert handled == [b"x", b"x"]
    assert link.written() == b"\x40\2\0\1\x40\2\0\2"


def test_a_retained_message_is_not_skipped_while_an_older_one_of_its_batch_may_change_that(link: Link) -> None:
    link.owner.policy.skips_retained = lambda topic: topic == b"b"
    link.sends(sent(b"1", topic="b", retain=True), sent(b"2"), sent(b"3", topic="b", retain=True))
    link.pump(until_read=2)
    assert [message.payload for message in link.messages] == [b"2", b"3"]


@pytest.mark.parametrize("retain", [False, True])
def test_what_waits_for_a_full_socket_is_stale_once_a_delivered_message_of_its_topic_follows(
    link: Link, retain: bool
) -> None:
    for _ in range(200):
        link.connection.publish(Message("full", bytes(100_000)))
    dropped = link.counters["dropped"]
    link.connection.publish(Message("a", b"stale", retain=retain))
    assert link.connection.publish(Message("a", b"newest", QoS.DELIVERED, retain=retain))
    assert link.counters["dropped"] == dropped + 1
    received = bytearray()

    def drained() -> bool:
        received.extend(link.written())
        link.connection.pump(0.0, link.messages.extend)
        return b"newest" in received

    assert until(drained)
    assert b"stale" not in received


@pytest.mark.parametrize(("stopped_s", "waited_s"), [(0.0, 0.0), (0.7, 0.7)])
def test_a_message_is_as_old_as_the_time_in_which_nothing_was_read(
    link: Link, stopped_s: float, waited_s: float
) -> None:
    """It lay in the socket while the process was stopped; the one after it did not."""
    link.idle(0.2)
    link.sends(sent(b"old"))
    link.now += stopped_s
    link.pump()
    assert link.answer_pings() <= 2
    link.idle(0.1)
    link.sends(sent(b"fresh"))
    link.pump()
    old, fresh = (message.waited_s for message in link.messages)
    assert waited_s <= old < waited_s + 0.15
    assert fresh < 0.15


def test_a_message_is_as_old_as_a_stop_of_the_process_while_it_waits_for_one(link: Link) -> None:
    link.idle(0.2)

    def stop() -> None:
        time.sleep(0.05)
        link.now += 1.5
        link.other.sendall(sent(b"old"))

    stopping = threading.Thread(target=stop)
    stopping.start()
    link.pump()
    stopping.join()
    assert 1.4 <= link.messages[0].waited_s <= 1.7


def test_a_ping_follows_at_once_when_nothing_was_read_for_a_while(link: Link) -> None:
    link.idle(0.6)
    assert link.answer_pings() == 1
    link.now += 0.2  # the next regular one is not due yet
    link.sends(sent(b"1"), sent(b"2"))
    link.pump(until_read=2)
    assert link.answer_pings() == 1


@pytest.mark.parametrize(
    ("thin", "silence_s", "round_trip_s", "limit_s"),
    [
        (False, 2.0, 0.0, 2.0),
        (False, 0.001, 0.0, 0.2),  # four pings
        (False, 0.2, 0.15, 0.6),  # and four round trips
        (True, 2.0, 0.0, 5.0),
        (True, 20.0, 0.0, 20.0),
        (True, 2.0, 0.9, 7.2),
    ],
)
def test_a_broker_that_answers_no_ping_is_silent(
    monkeypatch: pytest.MonkeyPatch, thin: bool, silence_s: float, round_trip_s: float, limit_s: float
) -> None:
    with closing(Link(monkeypatch, silence_s, round_trip_s)) as link:
        link.connection.suit(thin=thin)
        link.idle(limit_s - 0.1)
        with pytest.raises(Silent, match=f"broker has not answered for {limit_s} s"):
            link.idle(0.25)
        assert link.counters["silences"] == 1


def test_what_came_in_a_silence_is_not_read(link: Link) -> None:
    """Also if it is in the socket when the process goes on."""
    link.idle(0.2)
    link.sends(sent(b"old"))
    link.now += 3.0
    with pytest.raises(Silent):
        link.pump()
    assert link.messages == []


def test_retained_messages_and_pieces_of_long_ones_are_signs_of_life(link: Link) -> None:
    """The answers to pings are behind them."""
    long = sent(bytes(100_000))
    for number in range(20):
        link.now += 0.5
        link.sends(sent(b"x", retain=True) if number < 10 else long[(number - 10) * 1000 :][:1000])
        link.connection.pump(0.0, link.messages.extend)
    assert len(link.messages) == 10
    assert link.counters["silences"] == 0


def test_the_time_in_which_retained_messages_are_handled_is_no_silence(link: Link) -> None:
    def handle(messages: list[Message]) -> None:
        link.messages += messages
        link.now += 2.5

    for _ in range(5):
        link.sends(sent(b"x", retain=True))
        link.connection.pump(1.0, handle)
    assert link.messages
    assert link.counters["silences"] == 0


def test_an_acknowledgement_is_complete_after_what_came_before_it_was_delivered(link: Link) -> None:
    ack, seen = link.connection.subscribe([("a", False)]), list[bool]()
    link.sends(packet(0x90, b"\0\1\1"), sent(b"x", retain=True))
    while not seen:
        link.connection.pump(1.0, lambda messages: seen.extend(ack.is_set() for _ in messages))
    assert seen == [False]
    assert ack.is_set()


def test_a_discarded_connection_sends_nothing_more(link: Link) -> None:
    """What waits in the socket would arrive late, as if it were fresh."""
    for _ in range(200):
        link.connection.publish(Message("full", bytes(100_000)))
    link.connection.discard()
    with pytest.raises(ConnectionResetError):
        list(iter(lambda: link.other.recv(1 << 20), b""))


def test_a_client_that_leaves_closes_after_the_other_side(link: Link) -> None:
    """Else what that sends meanwhile has the connection reset, and a proxy may lose DISCONNECT with it."""
    parts = list[bytes]()

    def end() -> None:
        while not b"".join(parts).endswith(packets.DISCONNECT):
            parts.append(link.other.recv(4096))
        for _ in range(3):
            link.other.sendall(PONG)
            time.sleep(0.01)
        parts.append(link.other.recv(4096))  # a reset would raise
        link.other.close()

    other = threading.Thread(target=end)
    other.start()
    link.connection.publish(Message("a", b"1", QoS.DELIVERED))
    link.connection.disconnect()
    assert link.connection.client.socket is None
    other.join()
    assert parts[-1] == b""


def test_a_broker_without_qos_1_is_sent_no_more_than_its_socket_takes_but_stops(link: Link) -> None:
    link.connection.limits = Limits(qos=0)
    link.owner.policy.is_stop = lambda topic: topic == "stop"
    assert link.connection.publish(Message("full", bytes(20_000_000)))
    found = {topic: link.connection.publish(Message(topic, b"", QoS.DELIVERED)) for topic in ("a", "stop")}
    assert found == {"a": False, "stop": True}


def test_a_packet_may_be_as_long_as_the_broker_has_said(link: Link) -> None:
    link.connection.max_packet = 100
    longest = next(size for size in range(100, 0, -1) if link.connection.takes(Message("a" * 20, bytes(size))))
    for topic in ("a", "a" * 40):
        sizes = [size for size in range(100) if link.connection.takes(Message(topic, bytes(size)))]
        assert len(sizes) - 1 + len(topic) == longest + 20


def test_a_packet_has_eight_filters_at_most_and_what_was_asked_is_named_when_the_connection_is_lost(link: Link) -> None:
    names = [f"t/{number}" for number in range(20)]
    link.connection.subscribe([(name, False) for name in names])
    ack = link.connection.unsubscribe(names)
    filters = [Filter(name, 1) for name in names]
    parts = (filters[:8], filters[8:16], filters[16:])
    packed = [packets.subscribe(mid, part, modern=False) for mid, part in enumerate(parts, 1)]
    assert link.written().startswith(b"".join(packed))
    for mid, count in enumerate(map(len, parts)):
        link.sends(packet(0x90, bytes((0, mid + 1)) + b"\1" * count), packet(0xB0, bytes((0, mid + 4))))
        link.connection.pump(1.0, link.messages.extend)
        assert ack.is_set() is (mid == 2)
    link.connection.subscribe([(name, False) for name in names])
    link.other.close()
    with pytest.raises(Lost, match="asked to deliver t/0, t/1, t/2 and 17 more"):
        list(iter(lambda: link.connection.pump(1.0, link.messages.extend), ""))


# -- a thin link: patience, few pings, short queues


def test_a_ping_is_sent_at_least_every_second_and_a_half(link: Link) -> None:
    link.connection.suit(thin=True)
    asked = 0
    for _ in range(200):
        link.idle(0.05)
        asked += link.answer_pings()
    assert 6 <= asked <= 10, "a little more, so that two are never a period"
    assert link.counters["silences"] == 0


def test_anything_is_a_sign_of_life(link: Link) -> None:
    link.connection.suit(thin=True)
    for _ in range(20):
        link.idle(2.0)
        link.sends(sent(b"live"))
        link.pump()
    assert link.counters["silences"] == 0
    assert link.messages[-1].waited_s > 1.0, "which proves nothing about its age"


def test_how_long_an_answer_took_is_known(link: Link) -> None:
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


def test_the_socket_keeps_little_while_the_way_is_slow(link: Link) -> None:
    assert link.connection.client.socket is not None
    sizes = []
    for slow in (False, True, False):
        link.connection.suit(thin=slow)
        sizes.append(link.connection.client.socket.getsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT))
    assert sizes == [0, 4096, 0]


def test_packets_are_marked(broker: Broker) -> None:
    marks = []
    with create("mqtt", "client", MqttSettings(host="127.0.0.1", port=broker.port, dscp=46)):
        for link in list(Path("/proc/self/fd").iterdir()):
            with suppress(OSError, IndexError), socket.socket(fileno=os.dup(int(link.name))) as copy:
                if copy.getpeername()[1] == broker.port:
                    marks.append(copy.getsockopt(socket.IPPROTO_IP, socket.IP_TOS) & 0xFC)
    assert marks == [0xB8]


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
