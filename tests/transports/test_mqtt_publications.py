"""PUBLISH packets are read as paho reads them, only without its objects."""

from __future__ import annotations

import random
import struct
from typing import Any

import pytest
from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from pebble.transports.mqtt.connection import _Client

V3, V5 = MQTTProtocolVersion.MQTTv311, MQTTProtocolVersion.MQTTv5
Seen = tuple[Any, ...]


def client(kind: type[Client], protocol: MQTTProtocolVersion, seen: list[Seen]) -> Client:
    """One that notes what it delivers and acknowledges."""
    made = kind(CallbackAPIVersion.VERSION2, protocol=protocol)
    made.on_message = lambda _client, _data, raw: seen.append((raw._topic, bytes(raw.payload), raw.qos, raw.retain))
    made.on_publication = lambda topic, payload, first: seen.append(  # type: ignore[attr-defined]
        (topic, payload, first >> 1 & 3, bool(first & 1))
    )
    made.skips = lambda _topic: False  # type: ignore[attr-defined]
    made._send_puback = lambda mid: seen.append(("ack", mid)) or 0  # type: ignore[method-assign,func-returns-value]
    return made


def read(kind: type[Client], protocol: MQTTProtocolVersion, first: int, body: bytes) -> list[Seen]:
    seen: list[Seen] = []
    reading = client(kind, protocol, seen)
    packet = {"command": first, "packet": bytearray(body), "remaining_length": len(body), "have_remaining": 1}
    reading._in_packet.update(packet)  # type: ignore[typeddict-item]
    try:
        seen.append(("result", int(reading._handle_publish())))
    except Exception as error:
        seen.append(("error", type(error)))
    return seen


def packet(rng: random.Random, protocol: MQTTProtocolVersion) -> tuple[int, bytes]:
    """A PUBLISH of QoS 0 or 1: whole, with properties, with an odd topic, or damaged."""
    first = 0x30 | rng.choice((0, 2)) | rng.choice((0, 1)) | rng.choice((0, 8))
    topic = rng.choice((b"a/b", b"", b"\xff\xfe", "ü/ß".encode(), b"pebble/robots/goob/outgoing/online"))
    body = struct.pack("!H", len(topic)) + topic + (rng.randbytes(2) if first & 2 else b"")
    if protocol is V5:
        properties = Properties(PacketTypes.PUBLISH)
        if rng.random() < 0.3:
            properties.TopicAlias = rng.randrange(1, 9)
        if rng.random() < 0.3:
            properties.UserProperty = ("key", "v" * rng.choice((1, 200)))
        body += properties.pack()
    body += rng.randbytes(rng.choice((0, 1, 40)))
    if rng.random() < 0.3:
        body = body[: rng.randrange(len(body) + 1)]
    return first, body


@pytest.mark.parametrize("protocol", [V3, V5])
def test_every_packet_is_read_as_paho_reads_it(protocol: MQTTProtocolVersion) -> None:
    rng, own = random.Random(int(protocol)), 0
    for _ in range(3000):
        first, body = packet(rng, protocol)
        ours = read(_Client, protocol, first, body)
        assert ours == read(Client, protocol, first, body), (first, body)
        own += len(ours) > 1
    assert own > 1000  # most of them are delivered
