"""What a client writes and reads, byte by byte; how much it may send; its id."""

from __future__ import annotations

import random
import re
from collections.abc import Callable
from typing import Any

import pytest
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.reasoncodes import ReasonCode

from pebble.transports.base import Message, QoS
from pebble.transports.mqtt import packets, reasons
from pebble.transports.mqtt.client import SendQuota
from pebble.transports.mqtt.client_ids import unique
from pebble.transports.mqtt.packets import ANY_QOS, MAX_PACKET, RETAIN, Accepted, Filter, MalformedError, Reader
from tests.kit.mqtt_bytes import packet, text

NO_QUOTA = SendQuota(lambda _packet: None)
Seen = tuple[Any, ...]
both_versions = pytest.mark.parametrize("modern", [False, True])


class Noted:
    """Notes what a reader says."""

    def __init__(self, skipped: bytes = b"\0") -> None:
        self.seen: list[Seen] = []
        self._skipped = skipped

    def on_publication(self, topic: bytes, payload: bytes, first: int) -> None:
        self.seen.append((topic, payload, (first & ANY_QOS) >> 1, bool(first & RETAIN)))

    def skips(self, topic: bytes) -> bool:
        return topic == self._skipped

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *arguments: self.seen.append((name.removeprefix("on_"), *arguments))


def read(data: bytes, *, modern: bool, pieces: int = 1, most: int = 64, skipped: bytes = b"\0") -> tuple[Noted, Reader]:
    """``data`` in so many pieces of random sizes."""
    noted = Noted(skipped)
    reader = Reader(noted, NO_QUOTA, modern=modern)
    rng = random.Random(pieces)
    cuts = sorted(rng.randrange(len(data) + 1) for _ in range(pieces - 1))
    for begin, end in zip([0, *cuts], [*cuts, len(data)], strict=True):
        reader.feed(data[begin:end])
        while reader.read(most) or reader.unread:
            pass
    return noted, reader


def connect(*, modern: bool = False, bridge: bool = False, **given: Any) -> bytes:
    options: dict[str, Any] = {"keepalive_s": 300, "will": None, "username": None, "password": None, **given}
    return packets.connect("g", modern=modern, bridge=bridge, **options)


def publish(topic: str, qos: int, *, modern: bool, retain: bool = False, expires_s: int | None = None) -> bytes:
    return packets.publish(topic, b"x", qos, 258, retain=retain, modern=modern, expires_s=expires_s)


LOGIN = {"username": "u", "password": "p\xe4", "will": Message("a/\xfc", b"\xff!", QoS.DELIVERED, True)}
#: Each with another of its options.
ONE_OPTION = [Filter("a", 1, no_local=True), Filter("a", 1, as_published=True), Filter("a", 1, sends_retained=False)]
FILTERS = [Filter("a/#", 1, no_local=True, as_published=True, sends_retained=False), Filter("b", 0)]
#: What is written, as MQTT's chapter 3 has it: 3.1.1 and 5.
WRITTEN = [
    (connect(password="unused"), "100d 0004 4d515454 04 02 012c 0001 67"),
    (connect(modern=True), "100e 0004 4d515454 05 02 012c 00 0001 67"),
    (connect(bridge=True), "100d 0004 4d515454 84 02 012c 0001 67"),
    (connect(**LOGIN), "101f 0004 4d515454 04 ee 012c 0001 67 0004 612fc3bc 0002 ff21 0001 75 0003 70c3a4"),
    (
        connect(modern=True, **LOGIN),
        "1021 0004 4d515454 05 ee 012c 00 0001 67 00 0004 612fc3bc 0002 ff21 0001 75 0003 70c3a4",
    ),
    (connect(username="u", will=Message("b", b"")), "1015 0004 4d515454 04 86 012c 0001 67 0001 62 0000 0001 75"),
    (publish("a/\xfc", 0, modern=False), "3007 0004 612fc3bc 78"),
    (publish("a", 1, modern=False, retain=True), "3306 0001 61 0102 78"),
    (publish("a", 0, modern=True), "3005 0001 61 00 78"),
    (publish("a", 1, modern=True, expires_s=70_000), "320c 0001 61 0102 05 02 00011170 78"),
    (publish("a" * 124, 0, modern=False)[:5], "307f 007c 61"),
    (publish("a" * 125, 0, modern=False)[:6], "308001 007d 61"),
    (publish("a" * 20_000, 0, modern=False)[:5], "30a39c01 4e"),
    (packets.subscribe(258, FILTERS, modern=False), "820c 0102 0003 612f23 01 0001 62 00"),
    (packets.subscribe(258, FILTERS, modern=True), "820d 0102 00 0003 612f23 2d 0001 62 00"),
    (packets.subscribe(258, ONE_OPTION, modern=True), "820f 0102 00 0001 61 05 0001 61 09 0001 61 21"),
    (packets.unsubscribe(258, ["a/#", "b"], modern=False), "a20a 0102 0003 612f23 0001 62"),
    (packets.unsubscribe(258, ["a/#", "b"], modern=True), "a20b 0102 00 0003 612f23 0001 62"),
]


@pytest.mark.parametrize(("ours", "wanted"), WRITTEN)
def test_what_is_written(ours: bytes, wanted: str) -> None:
    assert ours == bytes.fromhex(wanted)


def test_a_text_that_is_too_long_is_refused() -> None:
    with pytest.raises(ValueError, match="65536 bytes where MQTT has room for 65535"):
        packets.unsubscribe(1, ["a" * 65_536], modern=False)


def publication(rng: random.Random, *, modern: bool) -> tuple[bytes, Seen]:
    """A PUBLISH of QoS 0 or 1, perhaps with properties, an odd topic, or of any length; and what it means."""
    qos, retain, duplicate = (rng.choice((0, 1)) for _ in range(3))
    topic = rng.choice((b"a/b", "\xfc/\xdf".encode(), b"pebble/robots/goob/outgoing/online"))
    body = text(topic) + (rng.randbytes(2) if qos else b"")
    if modern:
        expiry = rng.choice((b"", b"\2" + rng.randbytes(4)))
        properties = expiry + rng.choice((b"", *(b"\x26" + text(b"key") + text(bytes(size)) for size in (1, 200))))
        body += packet(0, properties)[1:]
    payload = rng.randbytes(rng.choice((0, 1, 40, 120, 3000)))
    return packet(0x30 | duplicate << 3 | qos << 1 | retain, body + payload), (topic, payload, qos, bool(retain))


class TestRead:
    @both_versions
    @pytest.mark.parametrize("pieces", [1, 2, 50, 4000])
    def test_publications_are_read_in_any_pieces(self, modern: bool, pieces: int) -> None:
        rng = random.Random(pieces)
        sent = [publication(rng, modern=modern) for _ in range(500)]
        noted, reader = read(b"".join(raw for raw, _ in sent), modern=modern, pieces=pieces)
        assert noted.seen == [meaning for _, meaning in sent]
        assert len(reader.acks) == 4 * sum(qos for _, (_, _, qos, _) in sent) > 400
        assert reader.unread == len(reader.partial) == 0

    def test_no_more_than_asked_for(self) -> None:
        reader = Reader(noted := Noted(), NO_QUOTA, modern=False)
        reader.feed(5 * packet(0x30, b"\0\1ax"))
        assert [reader.read(2) for _ in range(4)] == [2, 2, 1, 0]
        assert len(noted.seen) == 5

    @both_versions
    def test_each_other_packet(self, modern: bool) -> None:
        none = b"\0" if modern else b""
        data = b"".join(
            (
                packet(0x20, b"\0\0" + none),
                packet(0x90, b"\1\2" + none + b"\1\x80"),
                packet(0xB0, b"\1\3" + none),
                packet(0x40, b"\1\4"),
                packet(0x40, b"\1\5\x87" + none),
                packet(0xD0, b""),
                packet(0x62, b"\1\5"),
                packet(0xE0, b"\x8e"),
            )
        )
        noted, reader = read(data, modern=modern, pieces=20)
        assert noted.seen == [
            ("accepted", Accepted()),
            ("answer", 0x102, b"\1\x80"),
            ("answer", 0x103, b""),
            ("puback", 0x104, 0),
            ("puback", 0x105, 0x87),
            ("pong",),
            ("disconnect", 0x8E),
        ]
        assert bytes(reader.acks) == b"\x70\2\1\5"  # PUBCOMP

    def test_what_a_broker_allows(self) -> None:
        texts = b"\x12" + text("me") + b"\x26" + text("a") + text("b") + b"\x26" + text("c") + text("d")
        numbers = b"\x21\0\x14" + b"\x27\0\0\x10\0" + b"\x13\0\x1e" + b"\x25\0" + b"\x24\0"
        properties = packet(0, texts + numbers)[1:]  # their length, and all of them
        noted, _ = read(packet(0x20, b"\0\0" + properties), modern=True)
        assert noted.seen == [("accepted", Accepted(max_packet=4096, receive_maximum=20, max_qos=0, retain=0))]

    @both_versions
    def test_a_refusal_has_its_code(self, modern: bool) -> None:
        noted, _ = read(packet(0x20, b"\0\5"), modern=modern)
        assert noted.seen == [("refused", 5)]

    @both_versions
    def test_retained_messages_that_are_not_wanted_are_acknowledged_and_removals_delivered(self, modern: bool) -> None:
        properties = b"\0" if modern else b""
        data = packet(0x33, b"\0\1a\0\1" + properties + b"x") + packet(0x33, b"\0\1a\0\2" + properties)
        noted, reader = read(data, modern=modern, skipped=b"a")
        assert noted.seen == [(b"a", b"", 1, True)]
        assert bytes(reader.acks) == b"\x40\2\0\1\x40\2\0\2"

    @both_versions
    @pytest.mark.parametrize("pieces", [1, 300])
    @pytest.mark.parametrize("qos", [0, 1])
    def test_a_packet_that_is_too_long_is_discarded_but_acknowledged(self, modern: bool, pieces: int, qos: int) -> None:
        long = packet(0x30 | qos << 1, b"\0\3a/b\0\7" + bytes(MAX_PACKET))
        after = packet(0x30, b"\0\1a" + (b"\0" if modern else b"") + b"x")
        noted, reader = read(long + after, modern=modern, pieces=pieces)
        assert noted.seen == [("too_long", b"a/b", MAX_PACKET + 7), (b"a", b"x", 0, False)]
        assert bytes(reader.acks) == qos * b"\x40\2\0\7"
        assert not reader.partial

    @both_versions
    @pytest.mark.parametrize(
        ("data", "problem"),
        [
            (packet(0x30, b"\0\0x"), "without a topic"),
            (packet(0x30, b"\0\x09ax"), "ends in its head"),
            (packet(0x32, b"\0\1a\0"), "ends in its head"),
            (packet(0x36, b"\0\1a\0\1\0"), "QoS 3"),
            (packet(0x40, b"\0"), "begins with 40 and has 1 bytes"),
            (b"\x30\xff\xff\xff\xff\1", "a length of more than four bytes"),
            (packet(0x90, bytes(MAX_PACKET + 1))[:14], "begins with 90"),
            (b"HTTP/1.1 400 Bad Request\r\n", "begins with 48"),
        ],
    )
    def test_what_is_no_mqtt_is_refused(self, modern: bool, data: bytes, problem: str) -> None:
        with pytest.raises(MalformedError, match=problem):
            read(data + bytes(200), modern=modern)

    @both_versions
    def test_random_bytes_are_read_or_refused(self, modern: bool) -> None:
        rng, refused = random.Random(3), 0
        for _ in range(2000):
            reader = Reader(Noted(), NO_QUOTA, modern=modern)
            try:
                for _ in range(3):
                    reader.feed(bytes((rng.choice((0x30, 0x32, 0x20, 0x40, 0x90, 0xE0, rng.randrange(256))),)))
                    reader.read(64)
                    reader.feed(rng.randbytes(rng.randrange(40)))
                    while reader.read(64) or reader.unread:
                        pass
            except MalformedError:
                refused += 1
            assert len(reader.partial) <= MAX_PACKET
        assert 500 < refused < 2000


def test_no_more_is_in_flight_than_the_broker_takes() -> None:
    sent = list[bytes]()
    quota = SendQuota(sent.append)
    reader = Reader(Noted(), quota, modern=True)

    def receives(data: bytes) -> list[bytes]:
        reader.feed(data)
        reader.read(9)
        return sent

    receives(packet(0x20, b"\0\0\3\x21\0\2"))  # CONNACK: Receive Maximum 2
    assert [quota.takes(b"%d" % number) for number in range(5)] == [True, True, False, False, False]
    assert receives(packet(0x40, b"\0\1")) == [b"2"]
    assert receives(packet(0x40, b"\0\2") + packet(0x40, b"\0\3")) == [b"2", b"3", b"4"]
    receives(packet(0x40, b"\0\4") + 5 * packet(0x40, b"\0\5"))  # more answers than were asked for allow no more
    assert [quota.takes(b"x") for _ in range(3)] == [True, True, False]


@pytest.mark.parametrize(
    ("name", "begins"),
    [
        ("pebble/robots/goob/remote_bridge", "pebble_robots_goob_remote_bridge-"),
        ("a.b", "a_b-2e7336-"),
        ("pebble/robots/größe", "pebble_robots_gr__e-9ce5d0-"),
        ("\ud800", "_-"),
        ("", "-"),
    ],
)
def test_an_id_has_letters_digits_and_two_signs(name: str, begins: str) -> None:
    first, second = unique(name), unique(name)
    assert re.fullmatch(r"[A-Za-z0-9_-]*-[0-9a-f]{16}", first)
    assert first.startswith(begins)
    assert first[:-16] == second[:-16]
    assert first != second


def test_reasons_are_called_as_paho_calls_them() -> None:
    for code in range(0x80, 0xA3):
        name = ReasonCode(PacketTypes.DISCONNECT, identifier=0x80).names.get(code)
        if name is not None:
            assert reasons.words(code).lower() == next(iter(name)).lower()
