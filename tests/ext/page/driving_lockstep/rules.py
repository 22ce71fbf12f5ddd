"""What must hold, said of humans, pages, the server and the wheels; independent of how it is achieved.

1. No wheel turns outside a living gesture: after a release, or the loss of focus or sight, the page sends a zero at
   once; a page or a connection that stands still is noticed after 250 ms, a server that does after 400 ms.
2. No motion resumes by itself: a gesture begins with an action of the human, and only of inputs that were pressed
   after the last interruption.
3. No page is blocked for good: see rest.py.
4. Only the holder of the lease moves wheels; it is that of a robot which has given control to another no more.
5. After a stop nothing moves until a new gesture begins.
6. A command is at most 0.6 s old when the server forwards it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import msgspec

from pebble.contract.payloads import Drive
from pebble.extensions.page import messages as m
from tests.robot.lockstep.commands import Commands
from tests.robot.lockstep.owner import Owner, Wheels
from tests.robot.lockstep.scheduler import Scheduler

AGE_S = 0.6
VALID_S = 0.4
SILENCE_S, TICK_S = 0.25, 0.05
_EPS = 0.004
_DRIFT_S = 0.01  # clocks of pages drift apart from the server's


@dataclass(slots=True, eq=False)
class Command:
    """A command that the server has forwarded."""

    page: int
    tab: Any
    g: int
    sent: float
    sent_number: int
    published: float
    valid_s: float
    number: int


class RecordedWheels(Wheels):
    """``moved`` is called whenever the motors receive a line."""

    moved: Callable[[], None]

    def receive(self, line: bytes) -> None:
        super().receive(line)
        self.moved()


class Rules:
    """Call its methods when the thing happens. ``faults`` counts what disturbs the way from server to wheels."""

    def __init__(self, scheduler: Scheduler, base: str) -> None:
        self._scheduler, self._base, self._check = scheduler, base, scheduler.check
        self.sent: dict[tuple[int, float], tuple[float, int]] = {}  # by page and its own time
        self.commands = Commands()
        self.faults = 0
        self.path_s: Callable[[], float] = lambda: 0.0
        self.owner: Owner
        self.wheels: RecordedWheels
        self.driven: Callable[[], Any]  # the robot, by the server
        self._handling: tuple[Any, Any] | None = None
        self._newest: dict[Any, int] = {}  # by tab: the newest gesture
        self._over: dict[Any, int] = {}  # this one and all before it have ended
        self._received: dict[Any, float] = {}  # the newest command of that gesture
        self._newest_command: Command | None = None
        self._gap_s = 0.0  # between the newest two
        self._lost = 0  # the newest command before an outage
        self._holder = ""  # the client to which the robot has given control
        self.published = 0  # commands that move
        self.reachable: Callable[[], bool] = lambda: True  # the broker, by the server
        self.stopping: Callable[[], bool] = lambda: False  # an emergency stop is being sent, with zeros
        self.owner_up: Callable[[], bool] = lambda: True  # it receives commands
        self.moves = 0  # for statistics: how often the wheels began to turn
        self._turning: Command | None = None

    # -- the server

    def handling(self, control: Any, op: Any, before: bool) -> None:
        """The server takes a message of a page; ``op`` None: its connection has ended."""
        tab = control._tab
        if not before:
            self._handling = None
            self._over[tab] = max(self._over.get(tab, -1), tab.over)  # it may end more than it must
            if op is None:
                self._ends(tab, "a wheel turns though the connection of its page has ended")
            return
        self._handling = (control, op)
        if isinstance(op, m.DriveOp) and op.ref == self._base:
            if op.x or op.z or op.y:
                self._newest[tab] = max(self._newest.get(tab, -1), op.g)
                now = self._scheduler.now
                self._gap_s = now - self._received.get((tab, op.g), now)
                self._received[tab, op.g] = now
                if self._gap_s > SILENCE_S + _EPS:
                    self._over[tab] = max(self._over.get(tab, -1), op.g)
            else:
                self._over[tab] = max(self._over.get(tab, -1), op.g)
                self._stops_soon(
                    lambda one: one.tab is tab and one.g <= op.g, "a wheel turns after the zero of its gesture"
                )
        elif isinstance(op, m.StopOp) and op.ref == self._base:
            for other in list(self._newest):
                self._end_gestures(other)
            number = self.published
            self._stops_soon(lambda one: one.number <= number, "a wheel turns after a stop")
        elif isinstance(op, m.Lease) and op.ref == self._base and not op.take:
            self._ends(tab, "a wheel turns though its page has released the robot")

    def page_sends(self, page: int, t: float) -> None:
        """A page sends a command, stamped with its own time."""
        self.sent[page, t] = self._scheduler.now, len(self.sent) + 1

    def rewrite(self, topic: str, drive: Drive) -> Drive:
        """The server publishes a drive command: give it speeds by which it is known again."""
        if not topic.startswith(self._base):
            return drive
        if not drive.moves:
            self._zero()
            return drive
        control, op = self._handling or (None, None)
        now = self._scheduler.now
        self._check(isinstance(op, m.DriveOp) and op.ref == self._base, "the server makes up a command")
        assert control is not None
        assert op is not None
        tab = control._tab
        self._check(self.driven().tab is tab, "a page moves wheels without the lease")
        self._check(op.g > self._over.get(tab, -1), "a gesture goes on that has ended")
        sent, sent_number = self.sent[control.page, op.t]
        self._check(now - sent <= AGE_S + _DRIFT_S, "a command that is too old moves wheels")
        valid_s = drive.valid_ms / 1000 if isinstance(drive.valid_ms, int) else 9.0
        self.published += 1
        command = Command(control.page, tab, op.g, sent, sent_number, now, valid_s, self.published)
        self._watch_silence(command)
        self._newest_command = command
        x, z = self.commands.add(command)  # type: ignore[arg-type]
        return msgspec.structs.replace(drive, x=x, z=z, y=0.0)

    def _zero(self) -> None:
        """The server publishes a zero; by itself only if the gesture has ended."""
        command = self._newest_command
        if self._handling is not None or command is None or self.stopping():
            return
        tab, g = command.tab, command.g
        silent = self._scheduler.now - self._received[tab, g] > SILENCE_S
        ended = g <= self._over.get(tab, -1) or self.driven().tab is not tab
        self._check(silent or ended, "the server interrupts a gesture by a zero")

    def lease_moved(self, tab: Any) -> None:
        """It belongs to another page, or another server."""
        self._ends(tab, "a wheel turns by a page that no longer has the lease")

    def control_given(self, holder: str) -> None:
        """The robot publishes which client of this server, or of another one, has control."""
        self._holder, faults = holder, self.faults

        def look() -> None:
            if faults == self.faults and self._holder == holder and self.reachable():
                client = self.driven().client
                self._check(client is None or client.id == holder, "a page has the lease of a robot that another has")

        if holder and self.reachable():
            self._scheduler.after(SILENCE_S + TICK_S + self.path_s() + _EPS, look)

    # -- faults

    def page_stands_still(self, page: int, wait_s: float) -> None:
        """From now on nothing of that page arrives, or nothing is sent; what is on the way needs ``wait_s``."""
        number = len(self.sent)
        why = "a wheel turns though its page stands still"
        self._stops_soon(lambda one: one.page == page and one.sent_number <= number, why, wait_s + SILENCE_S + TICK_S)

    def server_stands_still(self) -> None:
        now = self._scheduler.now
        self.faults += 1
        self._stops_soon(
            lambda one: one.published <= now,
            "a wheel turns though the server stands still",
            VALID_S,
            needs_server=False,
        )

    def broker_is_lost(self) -> None:
        """Zeros are lost until it is back: what was forwarded before stops at its deadline."""
        self._lost = self.published
        self.server_stands_still()

    def let_go(self, page: int, first: int, wait_s: float, why: str, disturbed: Callable[[], object]) -> None:
        """Motion ends at a page that can act; the server knows after ``wait_s``, unless ``disturbed`` changes."""
        number = len(self.sent)
        what = f"a wheel turns though {why}"
        self._stops_soon(lambda one: one.page == page and first < one.sent_number <= number, what, wait_s, disturbed)

    # -- wheels

    def moved(self) -> None:
        """The motors have received a line."""
        now = self._scheduler.now
        command = self.turning()
        if command is not None and command is not self._turning:
            self.moves += self._turning is None
            self._check(not self.owner_latched(), "a wheel turns while its owner is latched")
            self._check(now - command.published <= self.path_s() + 0.5, "a command was on the way for too long")
            self._stops_soon(
                lambda one: one is command, "a wheel turns after its command's deadline", VALID_S, needs_server=False
            )
        self._turning = command

    def owner_latched(self) -> bool:
        service = self.owner.service
        return service is not None and bool(service._guard.latched)  # type: ignore[attr-defined]

    def turning(self) -> Command | None:
        speeds = self.wheels.speeds
        if speeds is None:
            return None
        command = self.commands.of(speeds)
        self._check(command is not None, "the wheels turn by a command that was never sent")
        return command  # type: ignore[return-value]

    # -- parts

    def _end_gestures(self, tab: Any) -> None:
        self._over[tab] = max(self._over.get(tab, -1), self._newest.get(tab, -1))

    def _ends(self, tab: Any, why: str) -> None:
        self._end_gestures(tab)
        number = self.published
        self._stops_soon(lambda one: one.tab is tab and one.number <= number, why)

    def _stops_soon(
        self,
        which: Callable[[Command], bool],
        why: str,
        after_s: float = 0.0,
        disturbed: Callable[[], object] = lambda: None,
        needs_server: bool = True,
    ) -> None:
        """Unless something disturbs it, no such command turns the wheels then."""
        faults, before = self.faults, disturbed()

        def look() -> None:
            if faults == self.faults and before == disturbed():
                command = self.turning()
                past = command is None or (needs_server and command.number <= self._lost)
                self._check(past or not which(command), why)

        if self.reachable() if needs_server else self.owner_up():  # else another deadline stops the wheels
            self._scheduler.after(after_s + self.path_s() + _EPS, look)

    def _watch_silence(self, command: Command) -> None:
        faults = self.faults

        def look() -> None:
            if faults == self.faults and self._received[command.tab, command.g] == command.published:
                turning = self.turning()
                silent = turning is None or turning.tab is not command.tab or turning.g != command.g
                self._check(silent, "a wheel turns though its gesture is silent")

        if self.reachable():
            self._scheduler.after(SILENCE_S + TICK_S + self.path_s() + _EPS, look)
