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
from tests.ext.lab.simulation import virtual_mqtt as mqtt

_IN_FLIGHT = 20  # mosquitto's max_inflight_messages
_QUEUED = 1000  # mosquitto's max_queued_messages


@dataclass(frozen=True, slots=True)
class Command:
    """A message of an operator: when it was published, whether it is retained, and when it left the broker's queue."""

    sent_at: float
    payload: bytes
    retained: bool
    topic: str
    left_at: float = 0.0


@dataclass(frozen=True, slots=True)
class Received:
    """What a client published."""

    at: float
    message: mqtt.Publish


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
        self.retained: dict[str, mqtt.Publish] = {}
        self.violations: list[str] = []
        self.refused: set[str] = set()  # topics that no client may subscribe to
        self._sessions: list[Session] = []
        self._backlog: deque[tuple[mqtt.Publish, Command]] = deque()

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
        self.route(mqtt.Publish(topic, payload, qos, retain))

    def route(self, message: mqtt.Publish) -> None:
        command = Command(self.now(), message.payload, retained=False, topic=message.topic)
        if self.frozen:
            self._backlog.append((message, command))
        elif self.running:
            self._route(message, command)

    def _route(self, message: mqtt.Publish, command: Command) -> None:
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
        self._will: mqtt.Publish | None = None
        self._wanted: dict[str, int] = {}
        self._patterns: list[str] = []  # those with wildcards
        self._limit_s = 10.0  # for the CONNECT; then the keepalive
        self._received_at = broker.now()
        self._number = 0
        self._in_flight: set[int] = set()
        self._queue: deque[tuple[mqtt.Publish, Command]] = deque()

    @property
    def queued(self) -> int:
        return len(self._queue)

    def feed(self, data: bytes) -> None:
        """Process bytes of the client."""
        self._buffer += data
        self._received_at = self._broker.now()
        try:
            while not self._broker.frozen and (found := mqtt.split(self._buffer)):
                self._handle(*found)
        except (mqtt.MqttError, struct.error, UnicodeDecodeError, IndexError) as error:
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

    def offer(self, message: mqtt.Publish, command: Command) -> None:
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

    def _deliver(self, message: mqtt.Publish, command: Command) -> None:
        if message.qos:
            self._number = self._number % 65535 + 1
            self._in_flight.add(self._number)
            message = replace(message, packet_id=self._number)
        self.line.send(mqtt.publish(message), replace(command, left_at=self._broker.now()))

    def _handle(self, kind: int, flags: int, body: bytes) -> None:
        if (kind == mqtt.CONNECT) == bool(self.client_id):
            raise mqtt.MqttError(f"a packet of type {kind} {'after' if self.client_id else 'before'} CONNECT")
        if kind == mqtt.CONNECT:
            self._connect(mqtt.read_connect(body))
        elif kind == mqtt.PUBLISH:
            self._published(mqtt.read_publish(flags, body))
        elif kind == mqtt.SUBSCRIBE:
            self._subscribe(*mqtt.read_subscribe(body))
        elif kind == mqtt.PINGREQ:
            self.line.send(mqtt.packet(mqtt.PINGRESP))
        elif kind == mqtt.PUBACK:
            self._acknowledged(*struct.unpack("!H", body))
        else:
            self._will = None
            self.close()

    def _connect(self, connect: mqtt.Connect) -> None:
        self.client_id, self._will = connect.client_id, connect.will
        self._limit_s = 1.5 * connect.keepalive_s or float("inf")
        self._broker.taken_over(by=self)
        self.line.send(mqtt.packet(mqtt.CONNACK, bytes(2)))

    def _published(self, message: mqtt.Publish) -> None:
        self._publish(message)
        if message.qos:
            self.line.send(mqtt.packet(mqtt.PUBACK, struct.pack("!H", message.packet_id)))

    def _publish(self, message: mqtt.Publish) -> None:
        self._broker.received.append(Received(self._broker.now(), message))
        self._broker.route(message)

    def _subscribe(self, number: int, wanted: list[tuple[str, int]]) -> None:
        refused = self._broker.refused
        self._patterns += [topic for topic, _ in wanted if "+" in topic and topic not in refused]
        codes = bytes(0x80 if topic in refused else min(qos, 1) for topic, qos in wanted)
        self._wanted.update((topic, qos) for topic, qos in wanted if topic not in refused)
        self.line.send(mqtt.packet(mqtt.SUBACK, struct.pack("!H", number) + codes))
        for topic, qos in wanted:
            for retained in [one for one in self._broker.retained.values() if matches(topic, one.topic)]:
                copy = replace(retained, qos=min(qos, retained.qos), retain=True)
                self._deliver(copy, Command(self._broker.now(), retained.payload, retained=True, topic=retained.topic))

    def _acknowledged(self, number: int) -> None:
        if number not in self._in_flight:
            raise mqtt.MqttError(f"a PUBACK for {number}, which was not sent")
        self._in_flight.discard(number)
        while self._queue and len(self._in_flight) < _IN_FLIGHT:
            self._deliver(*self._queue.popleft())
