"""A network in memory and virtual time for one simulated board: name server, time server and broker, and all faults."""

from __future__ import annotations

import errno
import socket
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Final, Literal

from pebble.extensions.lab.simulation.micropython.answers import name_answer, time_answer
from pebble.extensions.lab.simulation.micropython.clock import Clock
from pebble.extensions.lab.simulation.micropython.faults import failure
from pebble.extensions.lab.simulation.micropython.modules.sockets import (
    MAX_SOCKETS,
    Address,
    BoardSocket,
    numeric,
    socket_module,
)
from pebble.extensions.lab.simulation.micropython.modules.streams import POLLERR, POLLHUP, POLLIN, POLLOUT, Stream
from pebble.extensions.lab.simulation.micropython.modules.tls import ssl_module
from pebble.extensions.lab.simulation.micropython.modules.wlan import ADDRESS, Platform, Radio, network_module
from tests.ext.lab.simulation.virtual_broker import Command, Session, VirtualBroker

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
        self._up: deque[tuple[float, bytes]] = deque()
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

    @property
    def unacknowledged(self) -> int:
        """Writes of the board that have not reached the other end."""
        return len(self._up)

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
        room = WINDOW - sum(len(piece) for _, piece in self._up)
        data = data[: max(0, room)]
        if data:
            self._up.append((self._due(self._up[-1][0] if self._up else 0.0), data))
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
        while self._up and self._up[0][0] <= self._now() and self._session is not None:
            _, data = self._up.popleft()
            if self._ends_as is None:
                self._session.feed(data)
            elif self.state is State.OPEN:
                self.state = State.RESET  # the broker is not running
        if self.state is State.CLOSED and not self._up and self._session is not None:
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


class VirtualNetwork:
    """``modules()`` is for the board. ``step`` delivers what is due, and is called at every use of a socket.

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
        self.clock, self.broker = clock, broker
        self.radio = Radio(clock.now, platform)
        self.conditions = Conditions()
        self.arrivals: list[tuple[float, Command]] = []
        self.reads: list[Command] = []
        self.open: list[VirtualTcp | VirtualUdp] = []
        self.hosts: Mapping[str, str | Sequence[str]] = hosts
        self._wires: list[Wire] = []

    def modules(self) -> dict[str, Any]:
        """What a board has after power on or a reset: no socket, a radio that is off."""
        self.power_off()
        return {
            "network": network_module(self.radio),
            "socket": socket_module(self._socket),
            "ssl": ssl_module(),
        }

    def power_off(self) -> None:
        for sock in list(self.open):
            sock.close()
        self.radio.activate(False)

    def passable(self) -> bool:
        return self.radio.connected and not self.conditions.hole

    @property
    def unread(self) -> bool:
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

    def ask(self, place: Address, data: bytes) -> bytes | None:
        """What a server at ``place`` answers to a datagram."""
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

    def _socket(self, kind: int) -> VirtualTcp | VirtualUdp:
        if len(self.open) >= MAX_SOCKETS:
            raise OSError(errno.ENFILE, "too many sockets: one is not closed")
        made = VirtualTcp(self) if kind == socket.SOCK_STREAM else VirtualUdp(self)
        self.open.append(made)
        return made


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
        if self._network.radio.platform == "esp8266" and wire.unacknowledged >= _WRITES_8266:
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
        answer = network.ask(numeric(place), bytes(data)) if received else None
        if answer is not None:
            self._answers.append((network.clock.now() + 2 * network.conditions.latency_s(), answer, place))
        return len(data)

    def recvfrom(self, size: int) -> tuple[bytes, Address]:
        if not self.ready(POLLIN):
            raise failure(errno.EAGAIN)
        _, data, place = self._answers.popleft()
        return data[:size], place

    def ready(self, mask: int) -> int:
        """What poll() of the board reports."""
        there = self._network.passable() and self._answers and self._answers[0][0] <= self._network.clock.now()
        return ((POLLIN if there else 0) | POLLOUT) & mask
