"""An MQTT broker in memory and virtual time: enough for one robot and an operator, with mosquitto's limits.

QoS 0 and 1, retained messages, wills, keepalive, at most 20 messages in flight to a client. Protocol violations of
clients are recorded in ``violations``.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

from pebble.transports.topics import matches
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


def published(message: Publish) -> bytes:
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


_IN_FLIGHT = 20  # mosquitto's max_inflight_messages
_QUEUED = 1000  # mosquitto's max_queued_messages


@dataclass(frozen=True, slots=True)
class Command:
    """A message of an operator, whether it is retained, and when it left the broker's queue."""

    payload: bytes
    retained: bool
    topic: str
    left_at: float = 0.0


@dataclass(frozen=True, slots=True)
class Received:
    """What a client published."""

    at: float
    message: Publish


class Line(Protocol):
    """The broker's end of one connection."""

    def send(self, data: bytes, command: Command | None = None) -> None: ...

    def hang_up(self) -> None: ...


class VirtualBroker:
    """Connections are made by ``accept``, bytes come by Session.feed, time by ``step``."""

    def __init__(self, now: Callable[[], float]) -> None:
        self.now = now
        self.running = True
        self.frozen = False
        self.received: list[Received] = []
        self.retained: dict[str, Publish] = {}
        self.violations: list[str] = []
        self.refused: set[str] = set()  # topics that no client may subscribe to
        self._sessions: list[Session] = []
        self._backlog: deque[tuple[Publish, Command]] = deque()

    def kill(self) -> None:
        """Kill the broker: every connection is reset, and all state is lost."""
        self.running = self.frozen = False
        self._backlog.clear()
        sessions, self._sessions = self._sessions, []
        self.retained.clear()
        for session in sessions:
            session.line.hang_up()

    def start(self) -> None:
        self.running = True

    def accept(self, line: Line) -> Session:
        session = Session(self, line)
        self._sessions.append(session)
        return session

    def drop_all(self) -> None:
        """Disconnect every client."""
        for session in list(self._sessions):
            session.close()

    def freeze(self) -> None:
        """Suspend the broker with its connections open."""
        self.frozen = True

    def thaw(self) -> None:
        """Resume, and process what has arrived meanwhile, the operator's messages first."""
        self.frozen = False
        while self._backlog:
            self._route(*self._backlog.popleft())
        self.step()

    def publish(self, topic: str, payload: bytes, *, qos: int = 0, retain: bool = False) -> None:
        """Publish as the operator."""
        self.route(Publish(topic, payload, qos, retain))

    def route(self, message: Publish) -> None:
        command = Command(message.payload, retained=False, topic=message.topic)
        if self.frozen:
            self._backlog.append((message, command))
        elif self.running:
            self._route(message, command)

    def _route(self, message: Publish, command: Command) -> None:
        if message.retain and message.payload:
            self.retained[message.topic] = message
        elif message.retain:
            self.retained.pop(message.topic, None)
        for session in self._sessions:
            session.offer(replace(message, retain=False), command)

    def step(self) -> None:
        """Disconnect clients whose keepalive has expired."""
        if not self.frozen:
            for session in list(self._sessions):
                session.step()

    def taken_over(self, by: Session) -> None:
        """Close an older connection with the same client id."""
        for session in list(self._sessions):
            if session is not by and session.client_id == by.client_id:
                session.close()

    def forget(self, session: Session) -> None:
        if session in self._sessions:
            self._sessions.remove(session)

    @property
    def queued(self) -> int:
        """Number of messages that wait for acknowledgements of others."""
        return sum(session.queued for session in self._sessions)


class Session:
    """One connection of a client."""

    def __init__(self, broker: VirtualBroker, line: Line) -> None:
        self.line, self.client_id = line, ""
        self._broker = broker
        self._buffer = bytearray()
        self._will: Publish | None = None
        self._wanted: dict[str, int] = {}
        self._patterns: list[str] = []  # those with wildcards
        self._limit_s = 10.0  # for the CONNECT; then the keepalive
        self._received_at = broker.now()
        self._number = 0
        self._in_flight: set[int] = set()
        self._queue: deque[tuple[Publish, Command]] = deque()

    @property
    def queued(self) -> int:
        return len(self._queue)

    def feed(self, data: bytes) -> None:
        """Process bytes of the client."""
        self._buffer += data
        self._received_at = self._broker.now()
        try:
            while not self._broker.frozen and (found := split(self._buffer)):
                self._handle(*found)
        except (MqttError, struct.error, UnicodeDecodeError, IndexError) as error:
            self._broker.violations.append(f"{type(error).__name__}: {error}")
            self.close()

    def step(self) -> None:
        if self._buffer:
            self.feed(b"")  # what came while the broker was frozen
        if self._broker.now() - self._received_at > self._limit_s:
            self.close()

    def close(self) -> None:
        """Close the connection without a DISCONNECT: the will is published."""
        self._broker.forget(self)
        self.line.hang_up()
        if self._will is not None:
            will, self._will = self._will, None
            self._publish(will)

    def offer(self, message: Publish, command: Command) -> None:
        granted = self._granted(message.topic)
        if granted is None:
            return
        message = replace(message, qos=min(granted, message.qos))
        if message.qos and len(self._in_flight) >= _IN_FLIGHT:
            if len(self._queue) < _QUEUED:
                self._queue.append((message, command))
        else:
            self._deliver(message, command)

    def _granted(self, topic: str) -> int | None:
        exact = self._wanted.get(topic)
        if exact is not None or not self._patterns:
            return exact
        return max((self._wanted[one] for one in self._patterns if matches(one, topic)), default=None)

    def _deliver(self, message: Publish, command: Command) -> None:
        if message.qos:
            self._number = self._number % 65535 + 1
            self._in_flight.add(self._number)
            message = replace(message, packet_id=self._number)
        self.line.send(published(message), replace(command, left_at=self._broker.now()))

    def _handle(self, kind: int, flags: int, body: bytes) -> None:
        if (kind == CONNECT) == bool(self.client_id):
            raise MqttError(f"a packet of type {kind} {'after' if self.client_id else 'before'} CONNECT")
        if kind == CONNECT:
            self._connect(read_connect(body))
        elif kind == PUBLISH:
            self._published(read_publish(flags, body))
        elif kind == SUBSCRIBE:
            self._subscribe(*read_subscribe(body))
        elif kind == PINGREQ:
            self.line.send(packet(PINGRESP))
        elif kind == PUBACK:
            self._acknowledged(*struct.unpack("!H", body))
        else:
            self._will = None
            self.close()

    def _connect(self, connect: Connect) -> None:
        self.client_id, self._will = connect.client_id, connect.will
        self._limit_s = 1.5 * connect.keepalive_s or float("inf")
        self._broker.taken_over(by=self)
        self.line.send(packet(CONNACK, bytes(2)))

    def _published(self, message: Publish) -> None:
        self._publish(message)
        if message.qos:
            self.line.send(packet(PUBACK, struct.pack("!H", message.packet_id)))

    def _publish(self, message: Publish) -> None:
        self._broker.received.append(Received(self._broker.now(), message))
        self._broker.route(message)

    def _subscribe(self, number: int, wanted: list[tuple[str, int]]) -> None:
        refused = self._broker.refused
        self._patterns += [topic for topic, _ in wanted if "+" in topic and topic not in refused]
        codes = bytes(0x80 if topic in refused else min(qos, 1) for topic, qos in wanted)
        self._wanted.update((topic, qos) for topic, qos in wanted if topic not in refused)
        self.line.send(packet(SUBACK, struct.pack("!H", number) + codes))
        for topic, qos in wanted:
            for retained in [one for one in self._broker.retained.values() if matches(topic, one.topic)]:
                copy = replace(retained, qos=min(qos, retained.qos), retain=True)
                self._deliver(copy, Command(retained.payload, retained=True, topic=retained.topic))

    def _acknowledged(self, number: int) -> None:
        if number not in self._in_flight:
            raise MqttError(f"a PUBACK for {number}, which was not sent")
        self._in_flight.discard(number)
        while self._queue and len(self._in_flight) < _IN_FLIGHT:
            self._deliver(*self._queue.popleft())
