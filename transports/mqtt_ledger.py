"""What a broker still owes one connection: acknowledgements, and answers to requests and pings. Pure: no I/O."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass

from pebble.transports.base import Message, QoS

ROUND_TRIPS = 8  # answer times that are remembered


class Ticket:
    """A request to the broker that can be waited for. The loss of the connection ends the wait, too."""

    def __init__(self) -> None:
        self._answered = threading.Event()

    @property
    def done(self) -> bool:
        return self._answered.is_set()

    def wait(self, timeout: float) -> bool:
        return self._answered.wait(timeout)

    def settle(self) -> None:
        self._answered.set()


@dataclass(slots=True)
class _Unproven:
    """A kept message that the broker may not have: a PUBACK, or the answer to a later ping, proves that it has."""

    message: Message
    mid: int | None = None
    ping: int | None = None


class Ledger:
    """Message ids are MQTT's, times are seconds of one clock. Not locked: its connection is."""

    def __init__(self) -> None:
        self._round_trips: deque[float] = deque(maxlen=ROUND_TRIPS)  # the latest, seconds
        self._unacked: dict[int, str | None] = {}  # by message id: the topic, if kept
        self._unproven: dict[str, _Unproven] = {}  # newest kept message of each topic, oldest first
        self._requests: dict[int, Ticket] = {}
        self._answered: list[Ticket] = []  # nobody has been told yet
        self._pings: deque[tuple[float, Ticket | None]] = deque()  # unanswered: when sent, and who waits
        self._ping_number = self._pong_number = 0

    # -- messages

    @property
    def unacked(self) -> int:
        """How many DELIVERED messages the broker has not acknowledged."""
        return len(self._unacked)

    def unproven(self) -> list[Message]:
        """Kept messages that the broker may not have, oldest first."""
        return [entry.message for entry in self._unproven.values()]

    def accept(self, message: Message) -> None:
        """``message`` is ours to send from now on."""
        if message.retain:
            self._unproven.pop(message.topic, None)
            self._unproven[message.topic] = _Unproven(message)

    def sent(self, message: Message, mid: int) -> None:
        if message.qos is QoS.DELIVERED:
            self._unacked[mid] = message.topic if message.retain else None
        if message.retain:
            entry = self._unproven[message.topic]
            if message.qos is QoS.DELIVERED:
                entry.mid = mid
            else:
                entry.ping = self._ping_number + 1

    def acknowledge(self, mid: int) -> bool:
        """A PUBACK came; False if it was for nothing we know."""
        if mid not in self._unacked:
            return False
        topic = self._unacked.pop(mid)
        if topic is not None and topic in self._unproven and self._unproven[topic].mid == mid:
            del self._unproven[topic]
        return True

    # -- requests and pings

    def ask(self, mid: int, ticket: Ticket) -> None:
        self._requests[mid] = ticket

    def answer(self, mid: int) -> None:
        if mid in self._requests:
            self._answered.append(self._requests.pop(mid))

    def settle(self) -> None:
        """Tell those who wait for answers that they have come, once what came before them has been delivered."""
        answered, self._answered = self._answered, []
        for ticket in answered:
            ticket.settle()

    def ping(self, now: float, ticket: Ticket | None) -> None:
        self._pings.append((now, ticket))
        self._ping_number += 1

    def pong(self, now: float) -> None:
        if not self._pings:
            return
        sent_at, ticket = self._pings.popleft()
        self._pong_number += 1
        self.measured(now - sent_at)
        for topic in [t for t, entry in self._unproven.items() if entry.ping and entry.ping <= self._pong_number]:
            del self._unproven[topic]
        if ticket is not None:
            self._answered.append(ticket)

    def measured(self, round_trip_s: float) -> None:
        self._round_trips.append(round_trip_s)

    @property
    def round_trip_s(self) -> float:
        """The shortest of late: one answer that was late because the link stood still buys the next stall no time."""
        return min(self._round_trips, default=0.0)

    @property
    def pinged_at(self) -> float | None:
        """When the newest unanswered ping was sent."""
        return self._pings[-1][0] if self._pings else None

    def end(self) -> None:
        """Nobody will answer any more."""
        self.settle()
        for ticket in [*self._requests.values(), *(ticket for _, ticket in self._pings if ticket)]:
            ticket.settle()
        self._requests.clear()
        self._pings.clear()
