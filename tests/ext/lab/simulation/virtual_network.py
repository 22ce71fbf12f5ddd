"""A network in memory and virtual time for one simulated board: name server, time server, MQTT broker, and all faults.

The broker is enough for one robot and an operator, with mosquitto's limits: QoS 0 and 1, retained messages, wills,
keepalive, at most 20 messages in flight to a client. Protocol violations of clients are recorded in ``violations``.
"""

from __future__ import annotations

import errno
import socket
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Final, Literal

from pebble.extensions.lab.simulation.micropython.answers import name_answer, time_answer
from pebble.extensions.lab.simulation.micropython.clock import Clock
from pebble.extensions.lab.simulation.micropython.faults import failure
from pebble.extensions.lab.simulation.micropython.modules.sockets import Address, BoardSocket, HostNetwork, numeric
from pebble.extensions.lab.simulation.micropython.modules.streams import POLLERR, POLLHUP, POLLIN, POLLOUT, Stream
from pebble.extensions.lab.simulation.micropython.modules.wlan import ADDRESS, Platform
from pebble.transports.topics import matches
from tests.kit import mqtt_bytes

WINDOW = 5760  # bytes the board takes before its firmware reads: 4 segments, as lwIP has on both ports

_FIRST_RETRY_S = 1.0  # of an unanswered SYN; doubles


class State(Enum):
    CONNECTING = "connecting"
    OPEN = "open"
    FINISHED = "finished"  # by the broker
    RESET = "reset"
    REFUSED = "refused"
    CLOSED = "closed"  # by the board


class Wire:
    """``flow`` delivers what is due. Bytes that an outage held back arrive all at once when it ends, as with TCP.

    The network tells its condition, and is told of each command whose last byte reached the board, and was read there.
    """

    def __init__(self, network: VirtualNetwork, broker: VirtualBroker | None) -> None:
        self.state = State.CONNECTING
        self.inbox = bytearray()
        self._network, self._broker = network, broker
        self._now, self._conditions = network.clock.now, network.conditions
        self._marks: deque[tuple[int, Command]] = deque()  # of the bytes that the board received
        self._in = self._out = 0  # bytes of the inbox so far
        self._session: Session | None = None
        self.up: deque[tuple[float, bytes]] = deque()  # writes that have not reached the other end
        self._down: deque[tuple[float, bytes, Command | None]] = deque()
        self._ends_as: State | None = None  # once the broker hung up
        self._retry_s = _FIRST_RETRY_S
        self._syn_due = self._now() + 2 * self._conditions.latency_s()

    def flow(self) -> None:
        if self.state is State.CONNECTING:
            self._knock()
        elif self.state in (State.OPEN, State.CLOSED) and self._network.passable():
            if not self._conditions.mute:
                self._carry_up()
            self._carry_down()

    @property
    def over(self) -> bool:
        """Nothing will come of it any more."""
        closed = self.state is State.CLOSED and (self._session is None or self._ends_as is not None)
        return closed or self.state in (State.FINISHED, State.RESET, State.REFUSED)

    # -- the board's end

    def take(self, size: int) -> bytes:
        data = bytes(self.inbox[:size])
        del self.inbox[:size]
        self._out += len(data)
        while self._marks and self._marks[0][0] <= self._out:
            self._network.reads.append(self._marks.popleft()[1])
        return data

    def put(self, data: bytes) -> int:
        """Store what fits into the board's send buffer; return how many bytes that were."""
        room = WINDOW - sum(len(piece) for _, piece in self.up)
        data = data[: max(0, room)]
        if data:
            self.up.append((self._due(self.up[-1][0] if self.up else 0.0), data))
        return len(data)

    def close(self) -> None:
        """By the board: what is on its way to it has no reader any more."""
        self.state = State.CLOSED
        self._down.clear()
        self.inbox.clear()

    # -- the broker's end

    def send(self, data: bytes, command: Command | None = None) -> None:
        cut = self._conditions.cut(len(data))
        for piece, mark in ((data[:cut], None), (data[cut:], command)) if cut < len(data) else ((data, command),):
            self._down.append((self._due(self._down[-1][0] if self._down else 0.0), piece, mark))

    def hang_up(self) -> None:
        """Its end is closed; a broker that was killed leaves a reset behind."""
        alive = self._broker is not None and self._broker.running
        self._ends_as = State.FINISHED if alive else State.RESET

    def _due(self, behind: float) -> float:
        """When what is sent now arrives: nothing overtakes in TCP."""
        return max(behind, self._now() + self._conditions.latency_s())

    def _knock(self) -> None:
        if self._now() < self._syn_due:
            return
        if self._broker is None or self._conditions.mute or not self._network.passable():
            self._syn_due += self._retry_s
            self._retry_s *= 2
        elif self._broker.running:
            self.state, self._session = State.OPEN, self._broker.accept(self)
        else:
            self.state = State.REFUSED

    def _carry_up(self) -> None:
        while self.up and self.up[0][0] <= self._now() and self._session is not None:
            _, data = self.up.popleft()
            if self._ends_as is None:
                self._session.feed(data)
            elif self.state is State.OPEN:
                self.state = State.RESET  # the broker is not running
        if self.state is State.CLOSED and not self.up and self._session is not None:
            session, self._session = self._session, None
            if self._ends_as is None:
                session.close()

    def _carry_down(self) -> None:
        while self.state is State.OPEN and self._down and self._down[0][0] <= self._now():
            _, data, command = self._down[0]
            if len(self.inbox) >= WINDOW:
                return
            self._down.popleft()
            self.inbox += data
            self._in += len(data)
            if command is not None:
                self._marks.append((self._in, command))
                self._network.arrivals.append((self._now(), command))
        if self.state is State.OPEN and self._ends_as is not None and not self._down:
            self.state = self._ends_as


NAME_SERVERS: Final = ((ADDRESS[3], 53), ("224.0.0.251", 5353))
TIME_PORT = 123
HOSTS: Final[Mapping[str, str]] = {"broker.test": "10.0.0.2", "broker.local": "10.0.0.2", "pool.ntp.org": "10.0.0.3"}
BROKER: Final = ("10.0.0.2", 1883)
EPOCH_S = 1_800_000_000.0  # the time server's time at virtual time 0

_WRITES_8266 = 8  # lwIP's send queue there; one more waits, non-blocking or not (micropython issue 19704)
_STUCK_S = 10.0

Answers = Literal["answers", "silent", "nonsense"]


@dataclass(slots=True)
class Conditions:
    """The present condition of the network; ``latency_s`` is one way, ``cut`` splits packets."""

    hole: bool = False  # packets vanish, connections stay; TCP delivers later what it still holds
    mute: bool = False  # so do only the board's
    dns: Answers | Literal["no such name"] = "answers"
    ntp: Answers = "answers"
    latency_s: Callable[[], float] = field(default=lambda: 0.01)
    cut: Callable[[int], int] = field(default=lambda size: size)


class VirtualNetwork(HostNetwork):
    """The board's network, without this machine. ``step`` delivers what is due; every use of a socket calls it.

    ``arrivals`` are the operator's commands that reached the board, with the time their last byte did; ``reads`` are
    those that its firmware has read.
    """

    def __init__(
        self,
        clock: Clock,
        broker: VirtualBroker,
        *,
        platform: Platform = "esp32",
        hosts: Mapping[str, str | Sequence[str]] = HOSTS,
    ) -> None:
        super().__init__(clock, platform=platform)
        self.broker, self.hosts = broker, hosts
        self.conditions = Conditions()
        self.arrivals: list[tuple[float, Command]] = []
        self.reads: list[Command] = []
        self._wires: list[Wire] = []

    def passable(self) -> bool:
        return self.radio.connected and not self.conditions.hole

    @property
    def has_unread(self) -> bool:
        """Whether bytes have reached the board that its firmware has not taken yet."""
        return any(wire.inbox for wire in self._wires)

    def step(self) -> None:
        self.broker.step()
        for wire in self._wires:
            wire.flow()

    def wire(self, place: Address) -> Wire:
        """A new connection of the board; unanswered where there is no broker."""
        self._wires = [wire for wire in self._wires if not wire.over]
        wire = Wire(self, self.broker if place == BROKER else None)
        self._wires.append(wire)
        return wire

    def answer(self, data: bytes, place: Address) -> bytes | None:
        if place in NAME_SERVERS:
            known = {} if self.conditions.dns == "no such name" else self.hosts
            return self._spoilt(self.conditions.dns, name_answer(data, known.get))
        if place[1] == TIME_PORT:
            return self._spoilt(self.conditions.ntp, time_answer(data, EPOCH_S + self.clock.now()))
        return None

    @staticmethod
    def _spoilt(how: str, answer: bytes | None) -> bytes | None:
        if how == "silent" or answer is None:
            return None
        return bytes(byte ^ 0xA5 for byte in answer) if how == "nonsense" else answer

    def make(self, kind: int) -> BoardSocket:
        return VirtualTcp(self) if kind == socket.SOCK_STREAM else VirtualUdp(self)


class VirtualTcp(BoardSocket, Stream):
    """A TCP connection of the board."""

    def __init__(self, network: VirtualNetwork) -> None:
        super().__init__(network)
        self._wire: Wire | None = None

    def connect(self, place: Address) -> None:
        """Always raises: EINPROGRESS if it goes well."""
        self._need_wifi()
        self._wire = self._network.wire(numeric(place))
        raise failure(errno.EINPROGRESS)

    def close(self) -> None:
        super().close()
        if self._wire is not None and self._wire.state is not State.CLOSED:
            self._wire.close()

    def ready(self, mask: int) -> int:
        """What poll() of the board reports."""
        wire = self._current()
        if wire.state in (State.RESET, State.REFUSED):
            return POLLERR | POLLHUP | (mask & (POLLIN | POLLOUT))
        readable = POLLIN if wire.inbox or wire.state is State.FINISHED else 0
        return (readable | (POLLOUT if wire.state is State.OPEN else 0)) & mask

    def _receive(self, size: int) -> bytes | None:
        wire = self._current()
        if wire.inbox:
            return wire.take(size)
        self._check(wire)
        return b"" if wire.state is State.FINISHED else None

    def _send(self, data: bytes) -> int | None:
        wire = self._current()
        self._check(wire)
        if wire.state is State.CONNECTING and self._network.radio.platform == "esp32":
            raise failure(errno.EINPROGRESS)  # the ESP8266's lwIP takes early bytes
        if self._network.radio.platform == "esp8266" and len(wire.up) >= _WRITES_8266:
            self._network.clock.sleep(_STUCK_S)
            return None
        return wire.put(data) or None

    def _current(self) -> Wire:
        self._network.step()
        if self._wire is None or self._wire.state is State.CLOSED:
            raise failure(errno.ENOTCONN if self._wire is None else errno.EBADF)
        return self._wire

    @staticmethod
    def _check(wire: Wire) -> None:
        if wire.state in (State.RESET, State.REFUSED):
            raise failure(errno.ECONNREFUSED if wire.state is State.REFUSED else errno.ECONNRESET)


class VirtualUdp(BoardSocket):
    """A UDP socket of the board."""

    def __init__(self, network: VirtualNetwork) -> None:
        super().__init__(network)
        self._answers: deque[tuple[float, bytes, Address]] = deque()

    def sendto(self, data: bytes, place: Address) -> int:
        self._need_wifi()
        network = self._network
        received = network.passable() and not network.conditions.mute
        answer = network.answer(bytes(data), numeric(place)) if received else None
        if answer is not None:
            self._answers.append((network.clock.now() + 2 * network.conditions.latency_s(), answer, place))
        return len(data)

    def recvfrom(self, size: int) -> tuple[bytes, Address]:
        network = self._network
        if not (network.passable() and self._answers and self._answers[0][0] <= network.clock.now()):
            raise failure(errno.EAGAIN)
        _, data, place = self._answers.popleft()
        return data[:size], place


# -- the broker

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


class Body:
    """The rest of a packet's body."""

    def __init__(self, data: bytes) -> None:
        self.left = data

    def take(self, size: int) -> bytes:
        if len(self.left) < size:
            raise MqttError("a packet that is shorter than it says")
        taken, self.left = self.left[:size], self.left[size:]
        return taken

    def number(self) -> int:
        return int.from_bytes(self.take(2), "big")

    def data(self) -> bytes:
        return self.take(self.number())

    def text(self) -> str:
        return self.data().decode()


def split(buffer: bytearray) -> tuple[int, int, Body] | None:
    """Take the first packet out of ``buffer``: its type, flags and body; None while it is not complete."""
    sizes = bytes(buffer[1:5])
    end = next((at for at, byte in enumerate(sizes, 1) if not byte & 0x80), 0)  # of the bytes of its length
    if not end:
        if len(sizes) == 4:
            raise MqttError("a length of more than four bytes")
        return None
    whole = 1 + end + sum((byte & 0x7F) << 7 * place for place, byte in enumerate(sizes[:end]))
    if len(buffer) < whole:
        return None
    kind, flags, body = buffer[0] >> 4, buffer[0] & 0x0F, bytes(buffer[1 + end : whole])
    del buffer[:whole]
    if kind != PUBLISH and _CLIENT_FLAGS.get(kind) != flags:
        raise MqttError(f"no packet of a client: type {kind}, flags {flags}")
    return kind, flags, Body(body)


def packet(kind: int, body: bytes = b"") -> bytes:
    return mqtt_bytes.packet(kind << 4, body)


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
    """A message that a client published."""

    at: float
    message: Publish


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

    def accept(self, line: Wire) -> Session:
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
        return sum(len(session.queue) for session in self._sessions)


class Session:
    """One connection of a client."""

    def __init__(self, broker: VirtualBroker, line: Wire) -> None:
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
        self.queue: deque[tuple[Publish, Command]] = deque()

    def feed(self, data: bytes) -> None:
        """Process bytes of the client."""
        self._buffer += data
        self._received_at = self._broker.now()
        try:
            while not self._broker.frozen and (found := split(self._buffer)):
                self._handle(*found)
        except (MqttError, UnicodeDecodeError) as error:
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
            if len(self.queue) < _QUEUED:
                self.queue.append((message, command))
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
        data = mqtt_bytes.publish(message.topic, message.payload, message.qos, message.packet_id, retain=message.retain)
        self.line.send(data, replace(command, left_at=self._broker.now()))

    def _handle(self, kind: int, flags: int, body: Body) -> None:
        if (kind == CONNECT) == bool(self.client_id):
            raise MqttError(f"a packet of type {kind} {'after' if self.client_id else 'before'} CONNECT")
        if kind == CONNECT:
            self._connect(body)
        elif kind == PUBLISH:
            self._published(flags, body)
        elif kind == SUBSCRIBE:
            self._subscribe(body)
        elif kind == PINGREQ:
            self.line.send(packet(PINGRESP))
        elif kind == PUBACK:
            self._acknowledged(body.number())
        else:
            self._will = None
            self.close()

    def _connect(self, body: Body) -> None:
        name, level, flags, keepalive_s = body.text(), body.take(1)[0], body.take(1)[0], body.number()
        if (name, level) != ("MQTT", 4) or flags & 1:
            raise MqttError(f"not MQTT 3.1.1: {name} {level}")
        client_id, will = body.text(), None
        if flags & 4:
            will = Publish(body.text(), body.data(), flags >> 3 & 3, bool(flags & 0x20))
        for flag in (0x80, 0x40):  # a user name, a password
            if flags & flag:
                body.data()
        if body.left:
            raise MqttError("a CONNECT with something behind it")
        self.client_id, self._will = client_id, will
        self._limit_s = 1.5 * keepalive_s or float("inf")
        self._broker.taken_over(by=self)
        self.line.send(packet(CONNACK, bytes(2)))

    def _published(self, flags: int, body: Body) -> None:
        qos, topic = flags >> 1 & 3, body.text()
        number = body.take(2) if qos else b""
        if qos > 1 or number == bytes(2) or not topic or "+" in topic or "#" in topic:
            raise MqttError(f"a publish to {topic!r} with QoS {qos} and number {number!r}")
        self._publish(Publish(topic, body.left, qos, bool(flags & 1)))
        if qos:
            self.line.send(packet(PUBACK, number))

    def _publish(self, message: Publish) -> None:
        self._broker.received.append(Received(self._broker.now(), message))
        self._broker.route(message)

    def _subscribe(self, body: Body) -> None:
        number, wanted = body.take(2), list[tuple[str, int]]()
        while body.left:
            wanted.append((body.text(), body.take(1)[0]))
        if number == bytes(2) or not wanted or any(qos > 2 for _, qos in wanted):
            raise MqttError("a SUBSCRIBE without number or topics")
        refused = self._broker.refused
        self._patterns += [topic for topic, _ in wanted if "+" in topic and topic not in refused]
        codes = bytes(0x80 if topic in refused else min(qos, 1) for topic, qos in wanted)
        self._wanted.update((topic, qos) for topic, qos in wanted if topic not in refused)
        self.line.send(packet(SUBACK, number + codes))
        for topic, qos in wanted:
            for retained in [one for one in self._broker.retained.values() if matches(topic, one.topic)]:
                copy = replace(retained, qos=min(qos, retained.qos), retain=True)
                self._deliver(copy, Command(retained.payload, retained=True, topic=retained.topic))

    def _acknowledged(self, number: int) -> None:
        if number not in self._in_flight:
            raise MqttError(f"a PUBACK for {number}, which was not sent")
        self._in_flight.discard(number)
        while self.queue and len(self._in_flight) < _IN_FLIGHT:
            self._deliver(*self.queue.popleft())
