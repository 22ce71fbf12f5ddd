"""What transports share: bounds, ages, TLS and files that others replace meanwhile; how kinds are found."""

from __future__ import annotations

import shutil
import ssl
import threading
import tracemalloc
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path

import pytest

from pebble.errors import TransportError
from pebble.transports import GROUP, Message, QoS, State, base, create, own_retained
from pebble.transports.ages import MessageAges
from pebble.transports.base import Subscriptions
from pebble.transports.bounds import BoundedQueue, BoundedTable
from pebble.transports.counters import Counters
from pebble.transports.credentials import make_context
from pebble.transports.memory import MemoryHub, MemoryTransport
from pebble.transports.own_retained import OwnRetained
from pebble.transports.renewed import Renewed
from pebble.transports.settings import TlsSettings
from pebble.transports.topics import check_topic
from pebble.transports.zenoh.keymap import key_to_topic, topic_to_key
from tests.support import ROOT, WAIT_S, until


def test_retained_messages_are_bounded_and_those_that_were_known_first_are_sent_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An older value is not sent again in place of a newer one that is too large to be stored."""
    monkeypatch.setattr(own_retained, "LIMIT", 3)
    monkeypatch.setattr(own_retained, "BYTES", 1000)
    counters, again = Counters(), list[tuple[str, int]]()
    own = OwnRetained(counters)
    history = [("a", 400), ("b", 400), ("c", 400), ("a", 900), ("d", 500), ("e", 400)]
    stored = [own.remember(Message(topic, bytes(size), retain=True), sent=True) for topic, size in history]
    assert stored == [True, True, False, False, True, False]
    assert [own.remember(Message(topic, b"", retain=True), sent=False) for topic in "xy"] == [True, False]
    assert counters["forgotten"] == 4
    own.send_again({"b"}, lambda message: bool(again.append((message.topic, len(message.payload)))) or True)
    assert again == [("x", 0), ("d", 500)]


def test_long_topics_of_strangers_are_not_remembered() -> None:
    with MemoryTransport("client", MemoryHub()) as client:
        subscriptions, wanted = Subscriptions(), client.subscribe("a/#", lambda _: None)
        subscriptions.add(wanted)
        tracemalloc.start()
        for number in range(1000):
            assert subscriptions.matching(f"a/{number:60000}") == (wanted,)
            assert key_to_topic(topic_to_key(check_topic(f"a/{number:1000}"))) == f"a/{number:1000}"
        left, _ = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert left < 500_000


def test_a_slow_handlers_queue_is_bounded_in_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(base, "QUEUE_BYTES", 1000)
    goes_on, received = threading.Event(), list[int]()

    def handle(message: Message) -> None:
        goes_on.wait(WAIT_S)
        received.append(message.payload[0])

    with MemoryTransport("client", MemoryHub()) as client:
        slow = client.subscribe("#", handle)
        client.publish("t", bytes([0]), qos=QoS.DELIVERED)
        assert until(lambda: client.counters["delivered"] == 1)
        for number in range(1, 10):
            client.publish("t", bytes([number]) * 300, qos=QoS.DELIVERED)
        assert until(lambda: slow.dropped == 6)
        goes_on.set()
        assert until(lambda: received == [0, 7, 8, 9])
        assert slow.dropped == client.counters["dropped"] == 6


class TestQueue:
    def test_drops_as_many_as_a_large_one_needs(self) -> None:
        queue: BoundedQueue[str] = BoundedQueue(10, 100)
        for item in "abc":
            queue.append(item, 30)
        assert queue.append("large", 70) == ["a", "b"]
        assert queue.append("larger", 1000) == ["c", "large"]
        assert queue.append("small", 1) == ["larger"]
        assert len(queue) == 1
        queue.popleft()
        assert queue.append("b", 100) == []
        queue.clear()
        assert queue.append("c", 100) == []


class TestTable:
    def test_forgets_the_oldest_beyond_its_number(self) -> None:
        table: BoundedTable[bytes] = BoundedTable(2, 100, len)
        for topic in "abac":
            table[topic] = b"1"
        assert dict(table) == {"a": b"1", "c": b"1"}

    def test_one_that_is_too_large_leaves_the_others(self) -> None:
        table: BoundedTable[bytes] = BoundedTable(10, 100, len)
        table["a"] = table["b"] = b"1"
        table["a"] = bytes(100)
        assert dict(table) == {"b": b"1"}
        table["b" * 60] = b""
        table["c" * 60] = b""
        assert len(table) == 1, "topics count"

    def test_what_was_removed_makes_room(self) -> None:
        table: BoundedTable[bytes] = BoundedTable(10, 100, len)
        table["a"] = bytes(99)
        assert not table.put_if_room("b", b"")
        assert dict(table) == {"a": bytes(99)}
        del table["a"]
        assert table.put_if_room("b", bytes(99))
        table.clear()
        assert table.put_if_room("c", bytes(99))


# -- the age of messages from other machines, whose clocks started some other time


HERE, THERE, TOPIC = 1, 2, "a/b"
LATE_S = 2.0


class Receiver:
    """Its clock shows ``now``; the operator's is ``offset`` behind, and counts ``rate`` seconds per second."""

    def __init__(self, offset: float = 5000.0, rate: float = 1.0) -> None:
        self.ages = MessageAges(HERE, LATE_S)
        self._offset, self._rate = offset, rate

    def receives(self, now: float, journey: float = 0.01) -> float:
        return self.ages.age_s(THERE, TOPIC, (now - journey) * self._rate - self._offset, now)


@pytest.mark.parametrize("offset", [5000.0, -5000.0])
def test_what_piled_up_is_as_old_as_it_is(offset: float) -> None:
    receiver = Receiver(offset)
    assert [receiver.receives(now / 10) for now in range(10)] == pytest.approx([0.0] * 10, abs=0.01)
    piled_up = [receiver.receives(7.0, journey=journey) for journey in (6.0, 4.0, 2.5, 1.0, 0.01)]
    assert piled_up == pytest.approx([6.0, 4.0, 2.5, 1.0, 0.0], abs=0.02)


@pytest.mark.parametrize("rate", [1.0005, 0.9995])
def test_drifting_clocks_stay_comparable(rate: float) -> None:
    receiver = Receiver(rate=rate)
    assert max(receiver.receives(10.0 * turn) for turn in range(10_000)) < 0.1
    assert receiver.receives(100_010.0, journey=5.0) == pytest.approx(5.0, abs=0.1)


def test_standing_still_twice_is_no_reason_to_believe_old_messages() -> None:
    receiver = Receiver()
    receiver.receives(0.0)
    for now in (10.0, 20.0, 30.0):
        assert receiver.receives(now, journey=4.0) > LATE_S


def test_a_clock_that_stood_still_is_believed_again_soon() -> None:
    """A virtual machine was paused: all its messages seem late from then on, for ever."""
    receiver = Receiver()
    receiver.receives(0.0)
    seemed = [receiver.receives(100.0 + turn / 10, journey=60.0) for turn in range(100)]
    assert seemed[0] > LATE_S
    assert seemed[-1] == pytest.approx(0.0, abs=0.01)


def test_who_claims_to_be_another_machine_makes_nothing_of_it_late_on_other_topics() -> None:
    receiver = Receiver()
    for now in range(60):
        receiver.ages.age_s(THERE, "a/mine", now - 5000.0 + 10.0, now)
        assert receiver.receives(now) < LATE_S


def test_many_machines_take_no_memory() -> None:
    ages = MessageAges(HERE, LATE_S)
    for boot in range(10, 1000):
        ages.age_s(boot, TOPIC, 0.0, 0.0)
    assert len(ages.clocks.clocks) <= 256


class TheirTransport(MemoryTransport):
    """A transport as a third party's package would define it."""


def install(monkeypatch: pytest.MonkeyPatch, value: str) -> None:
    points = EntryPoints([EntryPoint(name="theirs", value=value, group=GROUP)])
    monkeypatch.setattr("importlib.metadata.entry_points", points.select)


def test_a_third_party_registers_through_an_entry_point(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, "tests.transports.test_base:TheirTransport")
    with create("theirs", "client", MemoryHub()) as transport:
        assert type(transport).__name__ == "TheirTransport"
        assert transport.state is State.CONNECTED
    with pytest.raises(TransportError, match='no transport "carrier-pigeon": known are ') as refused:
        create("carrier-pigeon", "client", None)
    assert {"memory", "mqtt", "theirs", "zenoh"} <= set(str(refused.value).partition("known are ")[2].split(", "))


def test_what_is_not_a_transport_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, "unittest.mock:Mock")
    with pytest.raises(TransportError, match="is not a pebble"):
        create("theirs", "client", None)


CERTS = ROOT / "tests" / "data" / "tls"


def shake_hands(ours: ssl.SSLContext, theirs: ssl.SSLContext) -> ssl.SSLObject:
    """Return our end of a connection to localhost; in memory."""
    there, back = ssl.MemoryBIO(), ssl.MemoryBIO()
    client = ours.wrap_bio(back, there, server_hostname="localhost")
    server = theirs.wrap_bio(there, back, server_side=True)
    for end in (client, server) * 4:
        with suppress(ssl.SSLWantReadError):
            end.do_handshake()
    return client


def agreed(version: ssl.TLSVersion) -> str | None:
    """Return what a connection agrees on with a server that speaks only ``version``."""
    theirs = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    theirs.load_cert_chain(CERTS / "server.crt", CERTS / "server.key")
    theirs.set_ciphers("ALL:@SECLEVEL=0")
    theirs.minimum_version = theirs.maximum_version = version
    return shake_hands(make_context(TlsSettings(ca_cert=CERTS / "ca.crt")), theirs).version()


@pytest.mark.filterwarnings("ignore:ssl.TLSVersion")
def test_nothing_below_1_2() -> None:
    with pytest.raises(ssl.SSLError, match=r"(?i)version|protocol"):
        agreed(ssl.TLSVersion.TLSv1_1)
    for version in (ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3):
        assert agreed(version) == version.name.replace("_", ".")


def _replaced(file: Path, text: str) -> None:
    fresh = file.with_name("fresh")
    fresh.write_text(text)
    fresh.replace(file)


def _linked(file: Path, text: str) -> None:
    """Renews as certbot does: the name stays, and leads to another file."""
    target = file.with_name(f"archive-{text}")
    target.write_text(text)
    file.unlink()
    file.symlink_to(target)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda file: _replaced(file, "2"), 2),
        (lambda file: _linked(file, "2"), 2),
        (lambda file: (shutil.rmtree(file.parent), file.parent.mkdir(), file.write_text("2")), 2),
        (lambda file: file.unlink(), 1),
        (lambda file: file.write_text("half writt"), 1),
        (lambda _file: None, 1),
    ],
)
def test_a_change_is_taken_up_and_what_cannot_be_used_is_not(
    tmp_path: Path, change: Callable[[Path], object], expected: int, caplog: pytest.LogCaptureFixture
) -> None:
    file = tmp_path / "certs" / "number"
    file.parent.mkdir()
    file.write_text("1")
    value = Renewed([file], lambda: int(file.read_text()))
    change(file)
    assert [value.get() for _ in range(3)] == [expected] * 3
    assert len([record for record in caplog.records if record.levelname == "WARNING"]) <= 1
    shutil.rmtree(file.parent, ignore_errors=True)
    file.parent.mkdir()
    file.write_text("3")
    assert value.get() == 3
