"""The memory transport without threads: messages travel as long as a schedule wants, twice, or not at all.

Messages of one sender to one receiver stay in order, as with every transport; those of two senders may overtake each
other, but nothing overtakes what was retained before the receiver subscribed. One that is older than the silence limit
of transports is lost together with its connection.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

from pebble.transports import Message
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.robot.lockstep.processes import Process
from tests.robot.lockstep.scheduler import Scheduler

_TRAVEL_S = 0.001
_SILENCE_S = 2.0  # a connection that has been silent for so long is closed
_RECENT = 4  # messages that a sender may send again

Noted = Callable[[Process, Message], None]


class Network(MemoryHub):
    """A hub whose deliveries take time."""

    def __init__(self, scheduler: Scheduler, arrived: Noted, published: Noted) -> None:
        super().__init__()
        self.scheduler, self.arrived, self.published = scheduler, arrived, published
        self._last: dict[tuple[Process | None, Connection], float] = {}  # arrivals
        self._recent: dict[Process, deque[tuple[Any, Connection, int]]] = {}

    def now(self) -> None:
        """Messages are as old as the services' own clock says."""

    def distribute(self, message: Message, publisher: Any) -> None:
        self.published(publisher.process, message)
        super().distribute(message, publisher)

    def carry(self, delivery: Any, client: Connection) -> None:
        """Let a message travel to one client."""
        sender = None if delivery.only is not None else delivery.publisher.process
        if sender is not None:
            self._recent.setdefault(sender, deque(maxlen=_RECENT)).append((delivery, client, client.number))
        self._send(delivery, client, client.number, sender)

    def repeat(self, sender: Process, messages: int) -> None:
        """The sender's newest messages arrive again, in their order, as after a lost acknowledgement."""
        for delivery, client, number in list(self._recent.get(sender, ()))[-messages:]:
            self._send(delivery, client, number, sender)

    def _send(self, delivery: Any, client: Connection, number: int, sender: Process | None) -> None:
        delay = _TRAVEL_S + client.process.delay + (sender.delay if sender is not None else 0.0)
        link = (sender, client)
        at = max(self.scheduler.now + delay, self._last.get(link, 0.0), self._last.get((None, client), 0.0))
        self._last[link] = at
        self.scheduler.at(at, lambda: client.process.do(lambda: client.arrive(delivery, number)))


class Connection(MemoryTransport):
    """A client of :class:`Network`; it does everything on the process's turn."""

    def __init__(self, process: Process, network: Network) -> None:
        super().__init__(process.name, network)
        self.process, self.network = process, network
        self.number = 0  # of the connection
        self._away = False
        process.connection = self

    def arrive(self, delivery: Any, number: int) -> None:
        if number != self.number or not self._present:
            return
        self._inbox.append(delivery)
        self._work()
        self.network.arrived(self.process, delivery.message)
        self.process.wake()

    def lose(self, seconds: float) -> None:
        """Lose the connection, and find the hub again later."""
        if self._away or self._stopping:
            return
        self._away = True
        if self._attached is not None:
            self._attached = 0  # no era of any hub
            self._work()
        self.network.scheduler.after(seconds, self.find)

    def silent(self, seconds: float) -> None:
        """The process was frozen for so long: what has waited is lost with the connection."""
        if seconds > _SILENCE_S:
            self.lose(0.05)

    # -- what the hub calls

    def receive(self, delivery: Any) -> None:
        self.network.carry(delivery, self)

    def wake(self) -> None:
        self.network.scheduler.after(_TRAVEL_S, lambda: self.process.do(self._notice))

    def vanish(self) -> None:
        self._stopping, self._attached = True, None

    # -- the interface to base

    def _open(self, timeout: float) -> None:
        self._stopping = False
        self._hub.enter(self)
        self.wake()

    def _close(self, will: Message | None) -> None:
        self._hub.leave(self)
        self.vanish()

    def _connect(self) -> None:
        self.number += 1
        super()._connect()

    def find(self) -> None:
        self._away = False
        self.wake()

    def _notice(self) -> None:
        while not (self._stopping or self._away or self._attached == self._hub.era):
            self._work()
        self.process.wake()
