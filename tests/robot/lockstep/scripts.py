"""Scripts as processes: the real core of the script API."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from itertools import count

from pebble.contract import DRIVE, ESTOP_STATE, codec
from pebble.contract.payloads import Drive
from pebble.errors import PayloadError
from pebble.extensions.operator.client.robot_estop import RobotEstop
from pebble.extensions.scripts.script.drive_sender import DriveSender
from pebble.extensions.scripts.script.guard import END_S
from pebble.extensions.scripts.script.robot import EXIT_ENDED
from pebble.transports import Message, QoS
from tests.robot.lockstep.commands import Command, Commands
from tests.robot.lockstep.network import Connection, Network
from tests.robot.lockstep.people import BASE
from tests.robot.lockstep.processes import Process

_BEGIN_S = 0.2  # until an interpreter has started
_RETURN_S = 0.01  # until main has noticed that it is to end
_EXIT_S = 0.001  # until its parent knows

Doings = Iterator[tuple[str, float]]  # what to do, and how long to wait after it


def _steady() -> Doings:
    while True:
        yield "drive", 0.1


def _pulse() -> Doings:
    while True:
        for _ in range(4):
            yield "drive", 0.1
        yield "zero", 0.3


def _flood() -> Doings:
    """More than 50 commands a second, and zeros in between."""
    while True:
        for _ in range(12):
            yield "drive", 0.004
        yield "zero", 0.0
        yield "zero", 0.15


def _finish() -> Doings:
    for _ in range(10):
        yield "drive", 0.1


def _fail() -> Doings:
    for _ in range(10):
        yield "drive", 0.1
    yield "raise", 0.0


def _crash() -> Doings:
    for _ in range(8):
        yield "drive", 0.1
    yield "crash", 0.0


def _busy() -> Doings:
    """Calls nothing of the robot for ever."""
    for _ in range(4):
        yield "drive", 0.1
    yield "compute", 1000.0


def _late() -> Doings:
    yield "wait", 1.5
    yield from _steady()


def _idle() -> Doings:
    yield "wait", 1000.0


PROGRAMS: dict[str, Callable[[], Doings]] = {
    "steady": _steady,
    "pulse": _pulse,
    "flood": _flood,
    "finish": _finish,
    "fail": _fail,
    "crash": _crash,
    "busy": _busy,
    "late": _late,
    "idle": _idle,
}


class Script(Process):
    """One process of a script; a parent may hold it as its child.

    It uses the script API, whose threads and transport are simulated, and whose rules are the real ones: tests of
    tests/ext/scripts/script say what it may publish.
    """

    _pids = count(100)

    def __init__(
        self, file: str, run: int, network: Network, commands: Commands, exited: Callable[[int], None]
    ) -> None:
        super().__init__(f"{file} {run}", network.scheduler)
        self.file, self.run = file, run
        self.pid = next(self._pids)
        self.running = True  # as its parent knows
        self.alive = True
        self.signalled = False  # it has been sent a signal
        self._network, self._commands, self._exited = network, commands, exited
        self._doings = PROGRAMS[file.partition("-")[0]]()
        self._next_at = self.scheduler.now + _BEGIN_S
        self.sender = DriveSender(self.run, self._publish)
        self.estop = RobotEstop(BASE)
        self.ended = False  # every call on the robot raises from now on
        self._busy = False
        self._driven = False  # before, nothing ends it but signals
        self._exit_code = 0
        self.turn_at(self._next_at)

    # -- the kernel

    def signal(self, number: signal.Signals) -> None:
        if not self.alive:
            return
        if number is signal.SIGKILL:
            self.exit(-number)
            return
        self.signalled = True
        self.do(lambda: self._end_on_signal(number))

    def kill(self, _: float) -> None:
        self.signal(signal.SIGKILL)

    def wait(self, timeout_s: float) -> None:
        """A parent that ends waits; the kernel has ended this process by then."""

    def exit(self, code: int) -> None:
        if not self.alive:
            return
        self.leave()

        def noticed() -> None:
            self.running = False
            self._exited(code)

        self.scheduler.after(_EXIT_S, noticed)

    # -- the program

    def turn(self) -> None:
        now = self.scheduler.now
        if now >= self._next_at and self.connection is None:
            self._begin()
        if self.connection is not None:
            self._react(now)
        while self.alive and now >= self._next_at:
            doing, wait = next(self._doings, ("return", 0.0))
            self._next_at = now + wait
            self._do(doing, now)
        if self.alive:
            self.turn_at(min(self._next_at, self._due))

    def _begin(self) -> None:
        """It has been loaded, and connects."""
        if self.ended:
            return
        connection = Connection(self, self._network).open(0.0)
        connection.subscribe(ESTOP_STATE.filter(BASE), self._receive_owner, direct=True)
        connection.subscribe(DRIVE.topic(BASE), self._receive_drive, direct=True)
        self._next_at = self.scheduler.now + 0.01

    def _react(self, now: float) -> None:
        """To messages that have arrived, and to time."""
        if not self._driven:
            return
        self.sender.owners(self.estop.states, now)
        self.sender.tick(now)
        why = self.sender.ended(now)
        if why and not self.ended:
            self._end(why, EXIT_ENDED)

    @property
    def _due(self) -> float:
        due = self.sender.due
        return float("inf") if due is None or self.ended or not self._driven else due

    def _do(self, doing: str, now: float) -> None:
        self._busy = doing == "compute"
        if doing == "drive":
            self._drive(now)
        elif doing == "zero":
            self._zero(now)
        elif doing == "crash":
            self.exit(-signal.SIGSEGV)
        elif doing in ("return", "raise"):
            self._end("it has finished", self._exit_code)
            self.exit(0 if doing == "return" else 1)

    def _drive(self, now: float) -> None:
        if self.ended:
            return
        self._driven = True
        x, z = self._commands.add(Command(self.run, self.name, now, 5.0, may_move=True))
        self.sender.owners(self.estop.states, now)
        self.sender.drive(Drive(x=x, z=z), now)

    def _zero(self, now: float) -> None:
        if self.ended:
            return
        self._driven = True
        self.sender.owners(self.estop.states, now)
        self.sender.drive(Drive(), now)

    def _end_on_signal(self, number: int) -> None:
        if self.connection is None:
            self.exit(128 + number)
        else:
            self._end("a signal", 128 + number)

    def _end(self, why: str, code: int) -> None:
        if self.ended:
            return
        self.ended, self._exit_code = True, code
        self.sender.end(why, self.scheduler.now)
        wait = END_S if self._busy else _RETURN_S
        self.scheduler.after(wait, lambda: self.do(lambda: self.exit(code)))

    # -- its connection

    def _publish(self, command: Drive) -> bool:
        assert self.connection is not None
        return self.connection.publish(DRIVE.topic(BASE), codec.encode(DRIVE, command), qos=QoS.DELIVERED)

    def _receive_owner(self, message: Message) -> None:
        self.estop.receive(message)

    def _receive_drive(self, message: Message) -> None:
        if not message.retain:
            try:
                self.sender.receive(codec.decode(DRIVE, message.payload), self.scheduler.now)
            except PayloadError:
                return
