"""MQTT 3.1.1 packets as bytes: cuts a stream into packets, reads and writes the few kinds that the gate handles."""

from collections.abc import Iterator
from enum import IntEnum
from typing import NamedTuple

MAX_PACKET = 256 * 1024  # bytes, header included
LEVEL = 4  # of the protocol: MQTT 3.1.1
_MQTT_5 = 5

_WILL, _WILL_BITS, _PASSWORD, _USER = 0x04, 0x3C, 0x40, 0x80


class Kind(IntEnum):
    """The packet types that matter here, in the upper half of the first byte (MQTT 3.1.1, table 2.1)."""

    CONNECT = 1
    CONNACK = 2
    PUBLISH = 3
    PUBACK = 4
    PUBREC = 5
    PUBREL = 6
    PUBCOMP = 7
    SUBSCRIBE = 8


class PacketError(Exception):
    """Bytes that are no packet of MQTT 3.1.1, or one that is too large. The connection cannot go on."""


class VersionError(Exception):
    """A CONNECT of another version of MQTT; ``answer`` is the CONNACK that this version defines."""

    def __init__(self, level: int) -> None:
        super().__init__(f"MQTT of protocol level {level}")
        self.answer = b"\x20\x03\x00\x84\x00" if level == _MQTT_5 else connack(1)


class PacketCutter:
    """Cuts one direction of a connection into whole packets."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, data: bytes) -> Iterator[bytes]:
        """The packets that ``data`` completes. Raises PacketError, after those before the malformed one."""
        self._buffer += data
        while (size := packet_size(self._buffer)) is not None and size <= len(self._buffer):
            packet = bytes(self._buffer[:size])
            del self._buffer[:size]
            yield packet


def packet_size(head: bytes | bytearray, limit: int | None = MAX_PACKET) -> int | None:
    """Size of the packet that ``head`` begins, in bytes with its header; None: too few bytes to know.

    Raises PacketError if the length is invalid or above ``limit``.
    """
    length = 0
    for at, byte in enumerate(head[1:5]):
        length |= (byte & 0x7F) << 7 * at
        if byte < 0x80:
            size = 2 + at + length
            if limit is not None and size > limit:
                raise PacketError(f"a packet of {size} bytes, more than {limit}")
            return size
    if len(head) >= 5:
        raise PacketError("the length of a packet has more than four bytes")
    return None


class Publish(NamedTuple):
    """A PUBLISH packet. ``packet_id`` is 0 at QoS 0."""

    topic: bytes
    payload: bytes
    qos: int
    packet_id: int
    dup: bool


class Connect(NamedTuple):
    """A CONNECT packet; ``will`` is its topic and message, ``will_bits`` its QoS and retain flag as in the flags."""

    flags: int
    keepalive: bytes
    client_id: bytes
    will: tuple[bytes, bytes] | None
    username: bytes | None
    password: bytes | None


def read_publish(packet: bytes) -> Publish:
    """Parse a PUBLISH packet. Raises PacketError."""
    fields = _Fields(packet)
    qos = packet[0] >> 1 & 3
    topic = fields.text()
    packet_id = fields.number() if qos else 0
    if qos == 3 or (qos and not packet_id):
        raise PacketError("a PUBLISH with QoS 3 or with packet id 0")
    return Publish(topic, fields.rest(), qos, packet_id, bool(packet[0] & 8))


def read_id(packet: bytes) -> int:
    """The packet id of a PUBREL. Raises PacketError."""
    return _Fields(packet).number()


def read_connect(packet: bytes) -> Connect:
    """Parse a CONNECT packet. Raises PacketError, or VersionError for other versions of MQTT."""
    fields = _Fields(packet)
    name, level = fields.text(), fields.byte()
    if name not in (b"MQTT", b"MQIsdp"):
        raise PacketError("a CONNECT of another protocol")
    if (name, level) != (b"MQTT", LEVEL):
        raise VersionError(level)
    flags, keepalive = fields.byte(), fields.take(2)
    if flags & 1 or (flags & _PASSWORD and not flags & _USER) or (not flags & _WILL and flags & _WILL_BITS):
        raise PacketError("a CONNECT with invalid flags")
    client_id = fields.text()
    will = (fields.text(), fields.text()) if flags & _WILL else None
    username = fields.text() if flags & _USER else None
    password = fields.text() if flags & _PASSWORD else None
    if fields.rest():
        raise PacketError("a CONNECT that is too long")
    return Connect(flags, keepalive, client_id, will, username, password)


def write_connect(connect: Connect) -> bytes:
    """The packet; its flags of will, user and password follow from the other fields."""
    flags = connect.flags & ~(_USER | _PASSWORD)
    if connect.will is None:
        flags &= ~_WILL_BITS
    texts = [connect.client_id, *(connect.will or ())]
    for flag, text in ((_USER, connect.username), (_PASSWORD, connect.password)):
        if text is not None:
            flags |= flag
            texts.append(text)
    body = b"\x00\x04MQTT" + bytes((LEVEL, flags)) + connect.keepalive + b"".join(map(_text, texts))
    return bytes((Kind.CONNECT << 4,)) + _length(len(body)) + body


def connack(code: int) -> bytes:
    """The answer to CONNECT that refuses it (MQTT 3.1.1, table 3.1)."""
    return bytes((Kind.CONNACK << 4, 2, 0, code))


def refusal(answer: bytes) -> str | None:
    """Why the broker's ``answer`` to CONNECT refuses it, "" if it does not; None: it is not complete."""
    if answer and answer[0] != Kind.CONNACK << 4:
        return "it does not speak MQTT"
    if len(answer) < len(connack(0)):
        return None
    return f"code {answer[3]}" if answer[3] else ""


def acknowledgement(kind: Kind, packet_id: int) -> bytes:
    """A PUBACK, PUBREC or PUBCOMP."""
    return bytes((kind << 4, 2)) + packet_id.to_bytes(2, "big")


def _text(text: bytes) -> bytes:
    return len(text).to_bytes(2, "big") + text


def _length(size: int) -> bytes:
    encoded = bytearray()
    while size >= 0x80:
        encoded.append(size & 0x7F | 0x80)
        size >>= 7
    return bytes((*encoded, size))


class _Fields:
    """Reads the body of a packet from front to back."""

    def __init__(self, packet: bytes) -> None:
        self._packet = packet
        self._at = next(at for at in range(1, 5) if packet[at] < 0x80) + 1  # behind the length

    def take(self, count: int) -> bytes:
        taken = self._packet[self._at : self._at + count]
        if len(taken) < count:
            raise PacketError("a packet ends inside a field")
        self._at += count
        return taken

    def byte(self) -> int:
        return self.take(1)[0]

    def number(self) -> int:
        return int.from_bytes(self.take(2), "big")

    def text(self) -> bytes:
        return self.take(self.number())

    def rest(self) -> bytes:
        return self._packet[self._at :]
