"""Processes in virtual time: they can be slow, frozen and killed."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from pebble.runtime.service import Service
from tests.robot.lockstep.scheduler import Scheduler

if TYPE_CHECKING:
    from tests.robot.lockstep.network import Connection


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
        wait = service.timers.wait(self.scheduler.now)
        if wait is not None:
            self.turn_at(self.scheduler.now + wait)
