"""Processes in virtual time, and the memory transport without threads between them.

What is due happens in order, at once, on one thread. Processes can be slow, frozen and killed. Messages travel as long
as a schedule wants, twice, or not at all. Those of one sender to one receiver stay in order, as with every transport;
those of two senders may overtake each other, but nothing overtakes what was retained before the receiver subscribed.
One that is older than the silence limit of transports is lost together with its connection.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable
from itertools import count
from math import inf
from typing import Any

from pebble.runtime.service import Service
from pebble.transports import Message
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.kit.schedules import ViolatedError

_TRAVEL_S = 0.001
_SILENCE_S = 2.0  # a connection that has been silent for so long is closed
_RECENT = 4  # messages that a sender may send again


class Scheduler:
    """Jobs by the time at which they are due; two of one time run in the order in which they were added."""

    def __init__(self, now: float) -> None:
        self.now = now
        self._heap: list[tuple[float, int, Callable[[], None]]] = []
        self._order = count()
        self._violated = ""

    def clock(self) -> float:
        return self.now

    def at(self, due: float, job: Callable[[], None]) -> None:
        heapq.heappush(self._heap, (max(due, self.now), next(self._order), job))

    def after(self, seconds: float, job: Callable[[], None]) -> None:
        self.at(self.now + seconds, job)

    def run(self, seconds: float) -> None:
        """Let time pass."""
        end = self.now + seconds
        while self._heap and self._heap[0][0] <= end:
            self.now, _, job = heapq.heappop(self._heap)
            job()
            if self._violated:
                raise ViolatedError(self._violated)
        self.now = end

    def check(self, holds: bool, rule: str) -> None:
        """A rule: if it does not hold, that ends the run, whatever is called in between."""
        if not holds:
            self._violated = self._violated or rule
            raise ViolatedError(self._violated)


class Process:
    """Something with a connection. What is to be done while it is frozen waits, as in a kernel."""

    def __init__(self, name: str, scheduler: Scheduler) -> None:
        self.name, self.scheduler = name, scheduler
        self.alive = False
        self.frozen = False
        self.delay = 0.0  # of each message from or to it
        self.connection: Connection | None = None
        self.frozen_at = 0.0
        self._waiting: list[Callable[[], None]] = []
        self._turn_at: float | None = None

    def do(self, job: Callable[[], None]) -> None:
        """Run ``job``, of the kernel's or of a thread of the transport, as soon as the process is not frozen."""
        if self.frozen:
            self._waiting.append(job)
        else:
            job()

    def wake(self) -> None:
        """There is something to do."""
        self.turn_at(self.scheduler.now)

    def turn_at(self, due: float) -> None:
        """Have a turn then, if none is sooner."""
        if self.alive and (self._turn_at is None or due < self._turn_at):
            self._turn_at = due
            self.scheduler.at(due, lambda: self._turn_if(due))

    def freeze(self) -> None:
        if self.alive and not self.frozen:
            self.frozen, self.frozen_at = True, self.scheduler.now

    def thaw(self) -> None:
        if not self.frozen:
            return
        self.frozen = False
        if self.connection is not None:
            self.connection.silent(self.scheduler.now - self.frozen_at)
        waiting, self._waiting = self._waiting, []
        for job in waiting:
            job()
        self._turn_at = None
        self.wake()

    def leave(self) -> None:
        """End, however: the kernel closes the connection."""
        self.alive = self.frozen = False
        self._waiting, self._turn_at = [], None
        connection, self.connection = self.connection, None
        if connection is not None:
            connection.network.crash(connection)

    def turn(self) -> None:
        """Do what is due; to override."""

    def _turn_if(self, due: float) -> None:
        if due == self._turn_at and self.alive and not self.frozen:
            self._turn_at = None
            self.turn()


class ServiceProcess(Process):
    """A real service, restarted by a launcher."""

    def __init__(self, name: str, scheduler: Scheduler, make: Callable[[Process], Service]) -> None:
        super().__init__(name, scheduler)
        self._make = make
        self.service: Service | None = None

    def start(self) -> None:
        if self.alive:
            return
        self.alive = True
        self.service = self._make(self)
        # Here all work waits for a turn of the process: a frozen one gets messages, and does nothing.
        self.service.run_if_idle = lambda _job: False  # type: ignore[method-assign]
        self.service.set_up()
        self.wake()

    def kill(self, restart_s: float | None) -> None:
        """End at once; its memory is lost. ``restart_s``: when the launcher starts it again; None: not by itself."""
        if not self.alive:
            return
        self.leave()
        self.service = None
        if restart_s is not None:
            self.scheduler.after(restart_s, self.start)

    def turn(self) -> None:
        service = self.service
        assert service is not None
        while service.turn(0):
            if not service.running:
                raise AssertionError(f"{self.name} ends by itself")
        if service.timers.next_due < inf:
            self.turn_at(max(self.scheduler.now, service.timers.next_due))


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
