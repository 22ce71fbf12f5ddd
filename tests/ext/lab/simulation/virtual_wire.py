"""One TCP connection between a simulated board and the broker in memory, over a path that can fail."""

from __future__ import annotations

from collections import deque
from enum import Enum
from typing import TYPE_CHECKING

from tests.ext.lab.simulation.virtual_broker import Command, Session, VirtualBroker

if TYPE_CHECKING:
    from tests.ext.lab.simulation.virtual_network import VirtualNetwork

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
        """What fits into the board's send buffer."""
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
