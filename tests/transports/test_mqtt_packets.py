"""What a client writes and reads is what paho writes and reads; how much it may send; its id."""

from __future__ import annotations

import random
import re
import select
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from itertools import product
from typing import Any

import pytest
from paho.mqtt.client import Client as PahoClient
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.subscribeoptions import SubscribeOptions

from pebble.transports.base import Message, QoS
from pebble.transports.mqtt import packets
from pebble.transports.mqtt.client import SendQuota
from pebble.transports.mqtt.client_ids import unique
from pebble.transports.mqtt.packets import ANY_QOS, MAX_PACKET, RETAIN, Accepted, Filter, MalformedError, Reader
from tests.kit.mqtt_bytes import packet

NO_QUOTA = SendQuota(lambda _packet: None)
V3, V5 = MQTTProtocolVersion.MQTTv311, MQTTProtocolVersion.MQTTv5
Seen = tuple[Any, ...]
Pahos = Callable[..., "Paho"]
both_versions = pytest.mark.parametrize("modern", [False, True])


class Paho:
    """A client of paho's, and the other end of its connection."""

    def __init__(self, client: PahoClient, keepalive_s: int = 60) -> None:
        self.client = client
        with socket.create_server(("127.0.0.1", 0)) as server:
            client.connect(*server.getsockname(), keepalive_s)
            self.other, _ = server.accept()
        self.hello = self.written()

    def written(self) -> bytes:
        """What has arrived at the other end."""
        parts = []
        while self.client.want_write() or select.select([self.other], [], [], 0.005)[0]:
            self.client.loop_write()
            if select.select([self.other], [], [], 0)[0]:
                parts.append(self.other.recv(1 << 20))
                if not parts[-1]:
                    break
        return b"".join(parts)

    def reads(self, data: bytes, count: int) -> list[Seen]:
        """The first publications in ``data``."""
        seen = list[Seen]()
        self.client.on_message = lambda _client, _data, raw: seen.append(
            (raw.topic.encode(), bytes(raw.payload), raw.qos, raw.retain)
        )
        sending = threading.Thread(target=self.other.sendall, args=(data,))
        sending.start()
        while len(seen) < count:
            self.client.loop_read()
        sending.join()
        return seen


@pytest.fixture
def pahos() -> Iterator[Pahos]:
    made: list[Paho] = []

    def make(*, modern: bool, **options: Any) -> Paho:
        made.append(Paho(PahoClient(CallbackAPIVersion.VERSION2, protocol=V5 if modern else V3, **options)))
        return made[-1]

    yield make
    for one in made:
        one.other.close()
        one.client.disconnect()


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


class TestWritten:
    """The same bytes as paho writes."""

    @both_versions
    @pytest.mark.parametrize("login", [(None, None), ("user", None), ("user", "pässword"), (None, "unused")])
    @pytest.mark.parametrize("will", [None, Message("a/ü", b"\xffgone", QoS.DELIVERED, True), Message("b", b"")])
    def test_connect(self, modern: bool, login: tuple[str | None, str | None], will: Message | None) -> None:
        client = PahoClient(CallbackAPIVersion.VERSION2, protocol=V5 if modern else V3, client_id="goob-1")
        client.username_pw_set(*login)
        if will is not None:
            client.will_set(will.topic, will.payload, int(will.qos), will.retain)
        username, password = login
        options: Any = {"modern": modern, "bridge": False, "keepalive_s": 15, "will": will}
        ours = packets.connect("goob-1", username=username, password=password, **options)
        paho = Paho(client, 15)
        assert ours == paho.hello
        paho.other.close()

    def test_bridge_mode(self) -> None:
        client = PahoClient(CallbackAPIVersion.VERSION2, protocol=V3, client_id="b")
        client.enable_bridge_mode()
        options: Any = {"will": None, "username": None, "password": None}
        paho = Paho(client)
        assert packets.connect("b", modern=False, bridge=True, keepalive_s=60, **options) == paho.hello
        paho.other.close()

    @both_versions
    @pytest.mark.parametrize("qos", [0, 1])
    def test_publish(self, pahos: Pahos, modern: bool, qos: int) -> None:
        paho = pahos(modern=modern)
        properties = Properties(PacketTypes.PUBLISH)
        properties.MessageExpiryInterval = 70_000
        for retain, size in product((False, True), (0, 127, 128, 20_000, 3_000_000)):
            for given, expires_s in ((None, None), (properties, 70_000))[: 1 + modern]:
                mid = paho.client.publish("a/ü", bytes(size), qos, retain, given).mid
                ours = packets.publish("a/ü", bytes(size), qos, mid, retain=retain, modern=modern, expires_s=expires_s)
                assert ours == paho.written()

    def test_subscribe_and_disconnect(self, pahos: Pahos) -> None:
        paho, flags = pahos(modern=True), (False, True)
        for no_local, as_published, sends_retained in product(flags, flags, flags):
            handling = {True: SubscribeOptions.RETAIN_SEND_ON_SUBSCRIBE, False: SubscribeOptions.RETAIN_DO_NOT_SEND}[
                sends_retained
            ]
            options = SubscribeOptions(1, no_local, as_published, handling)
            _, mid = paho.client.subscribe([("a/#", options), ("b", options)])
            wanted = [Filter(text, 1, no_local, as_published, sends_retained) for text in ("a/#", "b")]
            assert packets.subscribe(mid or 0, wanted, modern=True) == paho.written()
        paho = pahos(modern=False)
        paho.client.subscribe([("a/#", 1), ("b", 0)])
        assert packets.subscribe(1, [Filter("a/#", 1, True), Filter("b", 0)], modern=False) == paho.written()
        paho.client.disconnect()
        assert paho.written() == packets.DISCONNECT

    @both_versions
    def test_unsubscribe(self, pahos: Pahos, modern: bool) -> None:
        paho = pahos(modern=modern)
        paho.client.unsubscribe(["a/#", "b"])
        assert packets.unsubscribe(1, ["a/#", "b"], modern=modern) == paho.written()

    def test_a_text_that_is_too_long_is_refused(self) -> None:
        with pytest.raises(ValueError, match="65536 bytes where MQTT has room for 65535"):
            packets.unsubscribe(1, ["a" * 65_536], modern=False)


def publication(rng: random.Random, *, modern: bool) -> bytes:
    """A PUBLISH of QoS 0 or 1, perhaps with properties, an odd topic, or of any length."""
    first = 0x30 | rng.choice((0, 2)) | rng.choice((0, 1)) | rng.choice((0, 8))
    topic = rng.choice((b"a/b", "ü/ß".encode(), b"pebble/robots/goob/outgoing/online"))
    body = struct.pack("!H", len(topic)) + topic + (rng.randbytes(2) if first & 2 else b"")
    if modern:
        properties = Properties(PacketTypes.PUBLISH)
        if rng.random() < 0.3:
            properties.MessageExpiryInterval = rng.randrange(1, 9)
        if rng.random() < 0.3:
            properties.UserProperty = ("key", "v" * rng.choice((1, 200)))
        body += properties.pack()
    body += rng.randbytes(rng.choice((0, 1, 40, 120, 3000)))
    return packet(first, body)


class TestRead:
    @both_versions
    @pytest.mark.parametrize("pieces", [1, 2, 50, 4000])
    def test_publications_are_read_as_paho_reads_them_in_any_pieces(
        self, pahos: Pahos, modern: bool, pieces: int
    ) -> None:
        rng = random.Random(pieces)
        data = b"".join(publication(rng, modern=modern) for _ in range(500))
        noted, reader = read(data, modern=modern, pieces=pieces)
        assert noted.seen == pahos(modern=modern).reads(packet(0x20, b"\0\0" + modern * b"\0") + data, 500)
        assert len(noted.seen) == 500
        asked = sum(qos for _, _, qos, _ in noted.seen)
        assert len(reader.acks) == 4 * asked > 400
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
        properties = Properties(PacketTypes.CONNACK)
        properties.ReceiveMaximum, properties.MaximumPacketSize, properties.AssignedClientIdentifier = 20, 4096, "me"
        properties.UserProperty = [("a", "b"), ("c", "d")]
        properties.ServerKeepAlive, properties.RetainAvailable, properties.MaximumQoS = 30, 0, 0
        noted, _ = read(packet(0x20, b"\0\0" + properties.pack()), modern=True)
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
