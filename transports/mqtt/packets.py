"""MQTT's packets as bytes, 3.1.1 and 5: those that a client writes and reads. Knows neither sockets nor clocks.

Sources are MQTT 3.1.1 and MQTT 5.0 (OASIS), chapters 2 and 3 of each. ``modern`` means version 5.
"""

import struct
from collections import deque
from collections.abc import Callable, Iterable
from typing import Final, Protocol

from msgspec import Struct

from pebble.transports.base import Message

MAX_PACKET: Final = 1024 * 1024  # bytes; a longer one is read and discarded
HEAD: Final = 2 + 65_535 + 2  # bytes of a PUBLISH up to its message id, at most
MOST_IDS: Final = 65_535  # message ids have 16 bits
RETAIN: Final = 0b1  # in the first byte of a PUBLISH
ANY_QOS: Final = 0b110  # there, too: not 0 with QoS 1 or 2

PINGREQ: Final = b"\xc0\x00"
DISCONNECT: Final = b"\xe0\x00"

_CONNECT, _PUBLISH, _SUBSCRIBE, _UNSUBSCRIBE = 0x10, 0x30, 0x82, 0xA2
_QOS_1, _QOS_2 = 0b010, 0b100
_BRIDGE = 0x80  # added to the protocol level of 3.1.1: what mosquitto calls bridge mode
_CLEAN, _WILL, _WILL_RETAIN, _PASSWORD, _USERNAME = 0x02, 0x04, 0x20, 0x40, 0x80  # flags of CONNECT
_EXPIRY = 0x02  # property: seconds after which the broker discards a message
_RECEIVE_MAXIMUM, _MAXIMUM_QOS, _RETAIN_AVAILABLE, _MAXIMUM_PACKET = 0x21, 0x24, 0x25, 0x27
_NO_LOCAL, _AS_PUBLISHED, _NO_RETAINED = 0x04, 0x08, 0x20  # options of a subscription

#: Bytes of each property's value by its number; text and bytes begin with their length (MQTT 5.0, 2.2.2.2).
_SIZES = {
    **dict.fromkeys((0x01, 0x17, 0x19, 0x24, 0x25, 0x28, 0x29, 0x2A), 1),
    **dict.fromkeys((0x13, 0x21, 0x22, 0x23), 2),
    **dict.fromkeys((0x02, 0x11, 0x18, 0x27), 4),
}
_TEXTS = {0x03: 1, 0x08: 1, 0x09: 1, 0x12: 1, 0x15: 1, 0x16: 1, 0x1A: 1, 0x1C: 1, 0x1F: 1, 0x26: 2}  # how many texts


class MalformedError(Exception):
    """An error: the received bytes are not MQTT. Its text says what is wrong."""


# -- what a client writes


class Filter(Struct, frozen=True):
    """A filter of a SUBSCRIBE, with its options; all but ``qos`` belong to MQTT 5."""

    text: str
    qos: int
    no_local: bool = False
    as_published: bool = False
    sends_retained: bool = True


def connect(
    client_id: str,
    *,
    modern: bool,
    bridge: bool,
    keepalive_s: int,
    will: Message | None,
    username: str | None,
    password: str | None,
) -> bytes:
    """Return a CONNECT with a clean session. ``bridge``: in bridge mode, which only 3.1.1 has."""
    flags, payload = _CLEAN, _text(client_id)
    properties = b"\0" if modern else b""
    if will is not None:
        flags |= _WILL | int(will.qos) << 3 | (_WILL_RETAIN if will.retain else 0)
        payload += properties + _text(will.topic) + _bytes(will.payload)
    if username is not None:
        flags |= _USERNAME
        payload += _text(username)
        if password is not None:  # not without a user name: MQTT-3.1.2-22
            flags |= _PASSWORD
            payload += _text(password)
    level = 5 if modern else 4 | (_BRIDGE if bridge else 0)
    return _packet(_CONNECT, b"\0\4MQTT", struct.pack("!BBH", level, flags, keepalive_s), properties, payload)


def publish(
    topic: str, payload: bytes, qos: int, mid: int, *, retain: bool, modern: bool, expires_s: int | None
) -> bytes:
    """Return a PUBLISH; ``mid`` counts with QoS 1 only, ``expires_s`` with MQTT 5 only. Must be fast."""
    name = topic.encode()
    head = len(name).to_bytes(2, "big") + name
    if qos:
        head += mid.to_bytes(2, "big")
    if modern:
        head += b"\0" if expires_s is None else struct.pack("!BBI", 5, _EXPIRY, expires_s)
    first, size = _PUBLISH | qos << 1 | retain, len(head) + len(payload)
    if size < 128:
        return bytes((first, size)) + head + payload
    return b"".join((bytes((first,)), _variable(size), head, payload))


def subscribe(mid: int, filters: Iterable[Filter], *, modern: bool) -> bytes:
    wanted = [_text(filter_.text) + bytes((_options(filter_) if modern else filter_.qos,)) for filter_ in filters]
    return _packet(_SUBSCRIBE, mid.to_bytes(2, "big"), b"\0" if modern else b"", *wanted)


def _options(filter_: Filter) -> int:
    options = filter_.qos | (_NO_LOCAL if filter_.no_local else 0) | (_AS_PUBLISHED if filter_.as_published else 0)
    return options | (0 if filter_.sends_retained else _NO_RETAINED)


def unsubscribe(mid: int, filters: Iterable[str], *, modern: bool) -> bytes:
    return _packet(_UNSUBSCRIBE, mid.to_bytes(2, "big"), b"\0" if modern else b"", *map(_text, filters))


def _packet(first: int, *parts: bytes) -> bytes:
    body = b"".join(parts)
    return bytes((first,)) + _variable(len(body)) + body


def _text(text: str) -> bytes:
    return _bytes(text.encode())


def _bytes(data: bytes) -> bytes:
    if len(data) > 0xFFFF:
        raise ValueError(f"{len(data)} bytes where MQTT has room for 65535")
    return len(data).to_bytes(2, "big") + data


def _variable(size: int) -> bytes:
    """Return a length of one to four bytes, seven bits in each."""
    parts = bytearray()
    while size > 127:
        parts.append(size & 127 | 128)
        size >>= 7
    parts.append(size)
    return bytes(parts)


# -- what it reads


class Accepted(Struct, frozen=True):
    """Properties of a CONNACK without an error; None if the broker gives no value."""

    max_packet: int | None = None  # bytes that the broker takes
    receive_maximum: int | None = None  # messages of QoS 1 that may be unacknowledged
    max_qos: int | None = None
    retain: int | None = None  # 0: retains nothing


class Listener(Protocol):
    """Handlers of packets, called in the order in which packets came."""

    def on_accepted(self, accepted: Accepted) -> None: ...

    def on_refused(self, code: int) -> None:
        """Handle a CONNACK with an error; ``code`` is 3.1.1's or MQTT 5's, as the broker sent it."""

    def on_publication(self, topic: bytes, payload: bytes, first: int) -> None:
        """Handle a PUBLISH; ``first`` is the first byte of the packet, with QoS and retain."""

    def on_puback(self, mid: int, code: int) -> None:
        """Handle a PUBACK; ``code`` is MQTT 5's: a refusal from 128 on."""

    def on_answer(self, mid: int, codes: bytes) -> None:
        """Handle a SUBACK, with a code for each filter, or an UNSUBACK. Codes from 128 on are refusals."""

    def on_pong(self) -> None: ...

    def on_disconnect(self, code: int) -> None: ...

    def on_too_long(self, topic: bytes, length: int) -> None:
        """Note that a PUBLISH of ``length`` bytes was discarded because it is too long."""

    def skips(self, topic: bytes) -> bool:
        """True if a retained message of this topic is not wanted."""


class SendQuota:
    """A limit on unacknowledged messages of QoS 1 (the broker's Receive Maximum). Messages beyond it wait here."""

    def __init__(self, send: Callable[[bytes], None]) -> None:
        self._send = send
        self._left = self._most = MOST_IDS  # how many more may be sent now, and at most
        self._held: deque[bytes] = deque()

    def begin(self, most: int) -> None:
        """Set how many unacknowledged messages the broker accepts."""
        self._left = self._most = most

    def takes(self, packet: bytes) -> bool:
        """Return True if ``packet`` may be sent now, and count it; else keep it, to send it later."""
        if self._left <= 0:
            self._held.append(packet)
            return False
        self._left -= 1
        return True

    def acknowledged(self) -> None:
        if self._held:
            self._send(self._held.popleft())
        else:
            self._left = min(self._left + 1, self._most)


class Reader:
    """A parser of packets from received bytes; ``acks`` collects the acknowledgements to be written."""

    def __init__(self, listener: Listener, quota: SendQuota, *, modern: bool) -> None:
        self.acks = bytearray()
        self._listener, self._quota, self._modern = listener, quota, modern
        self._data, self._at = b"", 0  # received bytes, and where those begin that are not read yet
        self.partial = bytearray()  # a packet that is not whole
        self._needed = 0  # how many bytes it must have before `read` goes on
        self._discarded = 0  # bytes of a long packet that still come
        self._too_long = (b"", 0, b"")  # its topic, its length, and the answer to it

    @property
    def unread(self) -> int:
        """Number of bytes that wait for the next `read`: whole packets, and the beginning of another."""
        return len(self._data) - self._at

    def feed(self, data: bytes) -> None:
        """Give received bytes to the parser, when nothing is `unread`."""
        if self._discarded:
            data = self._discard(data)
        if self.partial:
            self.partial += data
            if len(self.partial) < self._needed:
                return
            data = bytes(self.partial)
            self.partial.clear()
        self._data, self._at = data, 0

    def read(self, most: int) -> int:
        """Give up to ``most`` whole packets to the listener; return how many. Raises MalformedError. Must be fast."""
        data, end, count = self._data, len(self._data), 0
        if not data:
            return 0
        while count < most:
            at = self._at
            if end - at < 2:
                if at < end:
                    self._keep(2)  # a type, and one byte of the length
                else:
                    self._data, self._at = b"", 0
                break
            size, start = data[at + 1], at + 2  # how many bytes follow the length, which has one to four, and where
            if size > 127 and start < end and (more := data[start]) < 128:  # two bytes, the usual length: no call
                size, start = size & 127 | more << 7, start + 1
            elif size > 127:
                size, start = _read_variable(data, at + 1)
                if size < 0:
                    self._keep(end - at + 1)  # its length is not whole: at least one more byte
                    break
            stop = start + size
            if size > MAX_PACKET:
                self._begin_discarding(start, stop)
                break
            if stop > end:
                self._keep(stop - at)
                break
            self._at = stop
            count += 1
            if data[at] & 0xF0 == _PUBLISH:
                self._publish(data, data[at], start, stop)
            elif data[at] == _PUBACK and size >= _SHORTEST[_PUBACK]:
                self._quota.acknowledged()
                self._listener.on_puback(data[start] << 8 | data[start + 1], data[start + 2] if size > 2 else 0)
            else:
                self._other(data[at], data[start:stop])
        return count

    def _keep(self, size: int) -> None:
        """Keep the beginning of a packet until it has ``size`` bytes."""
        self.partial += self._data[self._at :]
        self._needed = size
        self._data, self._at = b"", 0

    def _publish(self, data: bytes, first: int, start: int, stop: int) -> None:
        """Give a PUBLISH, whose topic begins at ``start``, to the listener. Must be fast."""
        topic_end = start + 2 + int.from_bytes(data[start : start + 2], "big")
        payload_at, topic = topic_end, data[start + 2 : topic_end]
        qos = first & ANY_QOS
        if qos:  # a message id follows the topic
            payload_at += 2
            if qos == _QOS_1:
                self.acks += b"\x40\x02" + data[topic_end:payload_at]  # PUBACK
            elif qos == _QOS_2:  # nothing is subscribed to with it: PUBREC, so that the broker goes on
                self.acks += b"\x50\x02" + data[topic_end:payload_at]
            else:
                raise MalformedError("a message of QoS 3")
        if self._modern and payload_at < stop and data[payload_at] < 128:  # properties, whose length has one byte
            payload_at += 1 + data[payload_at]
        elif self._modern and payload_at <= stop:  # their length has more bytes, or is not there
            size, size_bytes = _read_variable(data[payload_at : min(payload_at + 4, stop)], 0)
            payload_at = stop + 1 if size < 0 else payload_at + size_bytes + size  # stop + 1: refused below
        if payload_at > stop or not topic:
            raise MalformedError("a message that ends in its head" if topic else "a message without a topic")
        if not (first & RETAIN and payload_at < stop and self._listener.skips(topic)):  # an empty one is a removal
            self._listener.on_publication(topic, data[payload_at:stop], first)

    def _other(self, first: int, body: bytes) -> None:  # a packet that is neither a PUBLISH nor a whole PUBACK
        if first not in _SHORTEST or len(body) < _SHORTEST[first]:
            raise MalformedError(f"a packet that begins with {first:02x} and has {len(body)} bytes")
        if first in (_SUBACK, _UNSUBACK):
            codes = 2 + self._properties_size(body)
            self._listener.on_answer(body[0] << 8 | body[1], body[codes:])
        elif first == _PINGRESP:
            self._listener.on_pong()
        elif first == _PUBREL:
            self.acks += b"\x70\x02" + body[:2]  # PUBCOMP
        elif first == _CONNACK:
            self._connack(body)
        else:
            self._listener.on_disconnect(body[0] if body else 0)

    def _properties_size(self, body: bytes) -> int:
        """Return the size of the properties after the first two bytes; 0 on 3.1.1."""
        if not self._modern:
            return 0
        size, start = _read_variable(body, 2)
        return start - 2 + size if size >= 0 else len(body)

    def _connack(self, body: bytes) -> None:
        if body[1]:
            self._listener.on_refused(body[1])
            return
        values = properties(body[2 : 2 + self._properties_size(body)])  # by identifier; below as Accepted orders them
        accepted = Accepted(*map(values.get, (_MAXIMUM_PACKET, _RECEIVE_MAXIMUM, _MAXIMUM_QOS, _RETAIN_AVAILABLE)))
        if accepted.receive_maximum is not None:
            self._quota.begin(accepted.receive_maximum)
        self._listener.on_accepted(accepted)

    # -- packets that are too long

    def _begin_discarding(self, start: int, stop: int) -> None:
        """Begin to discard a PUBLISH, once its topic and message id are here."""
        data, at = self._data, self._at
        if data[at] & 0xF0 != _PUBLISH:
            raise MalformedError(f"a packet that begins with {data[at]:02x} and has {stop - start} bytes")
        if len(data) < start + HEAD:
            self._keep(start + HEAD - at)
            return
        topic_end = start + 2 + int.from_bytes(data[start : start + 2], "big")
        ack = b"\x40\x02" + data[topic_end : topic_end + 2] if data[at] & ANY_QOS == _QOS_1 else b""  # PUBACK
        self._too_long = data[start + 2 : topic_end], stop - start, ack
        self._discarded, self._data, self._at = stop - at, b"", 0
        self.feed(data[at:])  # discards what is here of the packet, and keeps what follows it

    def _discard(self, data: bytes) -> bytes:
        """Discard bytes of a long packet; return those after it."""
        after = data[self._discarded :]
        self._discarded -= len(data) - len(after)
        if not self._discarded:
            topic, size, ack = self._too_long
            self.acks += ack
            self._listener.on_too_long(topic, size)
        return after


_CONNACK, _PUBACK, _PUBREL, _SUBACK, _UNSUBACK, _PINGRESP, _DISCONNECT = 0x20, 0x40, 0x62, 0x90, 0xB0, 0xD0, 0xE0
_SHORTEST = {_CONNACK: 2, _PUBACK: 2, _PUBREL: 2, _SUBACK: 3, _UNSUBACK: 2, _PINGRESP: 0, _DISCONNECT: 0}  # bytes


def _read_variable(data: bytes, at: int) -> tuple[int, int]:
    """Return a length, or -1 if its end is missing, and the place after it. Raises MalformedError."""
    value = shift = 0
    for byte in data[at : at + 4]:
        at += 1
        value |= (byte & 127) << shift
        if byte < 128:
            return value, at
        shift += 7
    if shift == 28:
        raise MalformedError("a length of more than four bytes")
    return -1, at


def properties(data: bytes) -> dict[int, int]:
    """Return the numeric MQTT 5 properties, by property identifier. ``data`` begins with the properties' length."""
    values = dict[int, int]()
    if not data:
        return values
    _, at = _read_variable(data, 0)
    while at < len(data):
        number, at = data[at], at + 1
        size = _SIZES.get(number)
        if size is not None:
            values[number] = int.from_bytes(data[at : at + size], "big")
            at += size
        elif number in _TEXTS:
            for _ in range(_TEXTS[number]):  # skips as many texts, each of which begins with its length
                at += 2 + int.from_bytes(data[at : at + 2], "big")
        else:
            _, at = _read_variable(data, at)  # a subscription identifier, or one that no version has yet
    return values
