"""The run of another robot that drives this one, with a run number here. Pure.

Here a run of another robot is a script like any other: it gets a number, once, and :class:`DriveSender`, which every
script uses, ends it by the states of motor owners. A person ends it by any command. An ended run never continues.
"""

from collections.abc import Callable, Mapping

from pebble.contract.payloads import Drive, EstopState, NeighbourRefusal
from pebble.extensions.scripts.runs import SUPERSEDED, newest
from pebble.extensions.scripts.script.drive_sender import HOLD_S, DriveSender

VALID_MS = 300  # for which a command of another robot moves this one, at most

LOCAL, PERSON = "a script of its own runs", "a person drives it"


class Visit:
    """The run of another robot here. ``publish`` drives this robot. For one thread; times are of one clock.

    ``begin(robot, run)`` returns why that run cannot begin here. ``number(barred, received)`` returns its number here,
    newer than both arguments; None while a script of this robot runs. ``local_runs()`` returns True while one runs.
    """

    def __init__(
        self,
        begin: Callable[[str, int], str],
        number: Callable[[int, int], int | None],
        publish: Callable[[Drive], bool],
        local_runs: Callable[[], bool],
    ) -> None:
        self._begin, self._number, self._publish, self._local_runs = begin, number, publish, local_runs
        self._who = ("", 0)  # robot and its run that drive this one, or did so last
        self._sender = DriveSender(0, publish)  # of that run; before the first one it never drives
        self._states: Mapping[str, EstopState] = {}  # of this robot's motor owners
        self._received = 0  # the newest number of all commands here
        self._person_at = float("-inf")  # when a person last commanded
        self._refused: dict[str, NeighbourRefusal] = {}  # by robot: why its run did not begin, or has ended

    def command(self, name: str, drive: Drive, now: float) -> bool:
        """Handle a command of a robot that may drive this one; return False if it has no effect."""
        if not drive.signed or not isinstance(drive.run, int):
            return False  # no script's: it could neither be ended nor told from the next one
        is_new = self._who != (name, drive.run)
        if is_new and not (drive.moves and self._starts(name, drive.run, now)):  # a zero begins no run
            return False
        if drive.moves and not self._sender.ended(now) and self._local_runs():
            self._sender.end(LOCAL, now)  # then it refuses the command, below
        self._sender.owners(self._states, now)
        valid = drive.valid_ms if isinstance(drive.valid_ms, int) else VALID_MS
        return self._sender.drive(Drive(x=drive.x, z=drive.z, y=drive.y, valid_ms=min(valid, VALID_MS)), now)

    def owners(self, states: Mapping[str, EstopState], now: float) -> None:
        self._states = states
        self.tick(now)

    def received(self, drive: Drive, now: float) -> None:
        """Handle any drive command on this robot's own topic."""
        if not drive.signed:
            self._person_at = now
            self.end(PERSON, now)
            return
        if isinstance(drive.run, int):
            self._received = newest((self._received, drive.run))
        self._sender.receive(drive, now)  # one of a newer run here takes the place of this run

    def tick(self, now: float) -> None:
        self._sender.owners(self._states, now)
        self._sender.tick(now)
        self._sender.ended(now)

    def end(self, why: str, now: float) -> None:
        self._sender.end(why, now)

    @property
    def due(self) -> float | None:
        """Time at which to call :meth:`tick`; None: only after another event."""
        return self._sender.due

    def driver(self, now: float) -> str:
        """Return the robot whose run drives this one; empty if none does."""
        robot, _ = self._who
        return "" if self._sender.ended(now) else robot

    def refused(self, now: float) -> dict[str, NeighbourRefusal]:
        """Return why the newest run of each robot has no effect here, by robot."""
        name, run = self._who
        why = self._sender.refusal(now) if name else ""
        return self._refused | ({name: NeighbourRefusal(run=run, why=why)} if why else {})

    def _starts(self, name: str, run: int, now: float) -> bool:
        """Begin the run if nothing prevents it; True if it drives from now on."""
        why = self._begin(name, run)
        if not why and now - self._person_at < HOLD_S:
            why = PERSON
        number = None
        if not why:
            barred = newest(state.last_barred for state in self._states.values())
            number = self._number(barred, self._received)  # None while a script of this robot runs
        if number is None:
            refusal = self._refused.get(name)
            if refusal is None or refusal.run != run:  # of one run the first reason is kept
                self._refused[name] = NeighbourRefusal(run=run, why=why or LOCAL)
            return False
        self.end(SUPERSEDED, now)
        self._refused = self.refused(now)  # this adds why the run before this one has ended
        self._refused.pop(name, None)
        self._who, self._sender = (name, run), DriveSender(number, self._publish)
        return True
