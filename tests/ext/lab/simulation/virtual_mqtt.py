"""MQTT 3.1.1 packets as a broker reads and writes them. Pure; strict about what a client may send."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from tests.kit import mqtt_bytes

CONNECT, CONNACK, PUBLISH, PUBACK, SUBSCRIBE, SUBACK, PINGREQ, PINGRESP, DISCONNECT = 1, 2, 3, 4, 8, 9, 12, 13, 14

_CLIENT_FLAGS = {CONNECT: 0, PUBACK: 0, SUBSCRIBE: 2, PINGREQ: 0, DISCONNECT: 0}  # the low half of the first byte


class MqttError(Exception):
    """A client broke the protocol: a broker closes its connection."""


@dataclass(frozen=True, slots=True)
class Publish:
    topic: str
    payload: bytes
    qos: int = 0
    retain: bool = False
    packet_id: int = 0


@dataclass(frozen=True, slots=True)
class Connect:
    client_id: str
    keepalive_s: int
    will: Publish | None


def split(buffer: bytearray) -> tuple[int, int, bytes] | None:
    """Take the first packet out of ``buffer``: its type, flags and body; None while it is not complete."""
    length, shift, at = 0, 0, 1
    while True:
        if at >= len(buffer):
            return None
        length |= (buffer[at] & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if not buffer[at - 1] & 0x80:
            break
        if shift > 21:
            raise MqttError("a length of more than four bytes")
    if len(buffer) < at + length:
        return None
    kind, flags, body = buffer[0] >> 4, buffer[0] & 0x0F, bytes(buffer[at : at + length])
    del buffer[: at + length]
    if flags != _CLIENT_FLAGS.get(kind, flags) or (kind not in _CLIENT_FLAGS and kind != PUBLISH):
        raise MqttError(f"no packet of a client: type {kind}, flags {flags}")
    return kind, flags, body


def packet(kind: int, body: bytes = b"", flags: int = 0) -> bytes:
    return mqtt_bytes.packet(kind << 4 | flags, body)


def publish(message: Publish) -> bytes:
    return mqtt_bytes.publish(message.topic, message.payload, message.qos, message.packet_id, retain=message.retain)


def read_publish(flags: int, body: bytes) -> Publish:
    qos = flags >> 1 & 3
    topic, at = _text(body, 0)
    number = 0
    if qos:
        (number,) = struct.unpack_from("!H", body, at)
        at += 2
    if qos > 1 or (qos and not number) or not topic or "+" in topic or "#" in topic:
        raise MqttError(f"a publish to {topic!r} with QoS {qos} and number {number}")
    return Publish(topic, body[at:], qos, bool(flags & 1), number)


def read_connect(body: bytes) -> Connect:
    name, at = _text(body, 0)
    level, flags, keepalive = struct.unpack_from("!BBH", body, at)
    if (name, level) != ("MQTT", 4) or flags & 1:
        raise MqttError(f"not MQTT 3.1.1: {name} {level}")
    client_id, at = _text(body, at + 4)
    will = None
    if flags & 4:
        topic, at = _text(body, at)
        payload, at = _bytes(body, at)
        will = Publish(topic, payload, flags >> 3 & 3, bool(flags & 0x20))
    for flag in (0x80, 0x40):  # a user name, a password
        if flags & flag:
            _, at = _bytes(body, at)
    if at != len(body):
        raise MqttError("a CONNECT with something behind it")
    return Connect(client_id, keepalive, will)


def read_subscribe(body: bytes) -> tuple[int, list[tuple[str, int]]]:
    (number,) = struct.unpack_from("!H", body, 0)
    at, wanted = 2, []
    while at < len(body):
        topic, at = _text(body, at)
        wanted.append((topic, body[at]))
        at += 1
    if not number or not wanted or any(qos > 2 for _, qos in wanted):
        raise MqttError("a SUBSCRIBE without number or topics")
    return number, wanted


def _bytes(body: bytes, at: int) -> tuple[bytes, int]:
    (length,) = struct.unpack_from("!H", body, at)
    if at + 2 + length > len(body):
        raise MqttError("a string that is longer than its packet")
    return body[at + 2 : at + 2 + length], at + 2 + length


def _text(body: bytes, at: int) -> tuple[str, int]:
    raw, at = _bytes(body, at)
    return raw.decode(), at
