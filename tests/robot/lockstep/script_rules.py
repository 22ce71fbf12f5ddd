"""What must hold of scripts and their manager, said of messages that arrive, processes that run and their signals.

* Never are scripts of two starts alive, and never does a script start that no live command has asked for since the
  last stop. A script by hand counts as a person's program.
* Runs have numbers that only grow.
* No script starts while a motor owner is known to be stopped.
* At the end of the turn in which the manager has received a stop, or a state of a motor owner that ends the run (it is
  stopped, was stopped or restarted since the start, or has barred the run), the script has been signalled to end.
* In the turn in which the manager notices the end of a script, it publishes a zero with its run, and it publishes no
  other drive commands than zeros with numbers of runs.
"""

from __future__ import annotations

from pebble.contract import AUTONOMY_COMMAND, DRIVE, ESTOP_STATE, codec
from pebble.contract.payloads import AutonomyCommand, Drive, EstopState
from pebble.errors import PayloadError
from pebble.transports import Message
from tests.robot.lockstep.manager import NAMES, Manager
from tests.robot.lockstep.people import BASE
from tests.robot.lockstep.scheduler import Scheduler
from tests.robot.lockstep.scripts import Script

_START, _STOP = "start", "stop"


class ScriptRules:
    """The rules of the manager; ``arrived`` and ``published`` are called with its messages."""

    def __init__(self, manager: Manager, scheduler: Scheduler) -> None:
        self._manager, self._check = manager, scheduler.check
        self.newest_run = 0
        self._life = 0
        self._state: EstopState | None = None
        self._known: EstopState | None = None  # that the manager had handled at the end of its last turn
        self._arriving: list[EstopState | None] = []  # in this turn
        self._baselines: list[EstopState | None] = []  # of which one was known when the newest script was started
        self._order = 0  # of commands
        self._starts: list[int] = []  # that may still lead to a script
        self._stop = 0  # the newest one of this turn; 0: none
        self._halted: set[int] = set()  # runs of which the manager has published a zero in this turn
        self._mine: list[Script] = []  # of this life of the manager
        self._alive: set[Script] = set()  # as the manager knew at the end of its last turn
        manager.before, manager.after, manager.spawned = self._before_turn, self._after_turn, self._spawned

    def arrived(self, message: Message) -> None:
        """A message is delivered to the manager."""
        self._note_life()
        if message.topic == AUTONOMY_COMMAND.topic(BASE) and not message.retain:
            self._command(message)
        elif message.topic.startswith(ESTOP_STATE.filter(BASE).removesuffix("+")) and message.payload:
            self._state = codec.decode(ESTOP_STATE, message.payload)
            self._arriving.append(self._state)

    def published(self, message: Message) -> None:
        """The manager publishes something."""
        if message.topic != DRIVE.topic(BASE):
            return
        drive: Drive = codec.decode(DRIVE, message.payload)
        self._check(drive.signed and isinstance(drive.run, int), "the manager publishes an unsigned command")
        self._check(not drive.moves, "the manager drives")
        if not drive.moves and isinstance(drive.run, int):
            self._halted.add(drive.run)

    def begins(self, run: int) -> None:
        """A script by hand."""
        self._check(run > self.newest_run, "the number of a run does not grow")
        self.newest_run = run

    # -- the manager's turns

    def _before_turn(self) -> None:
        self._note_life()
        self._halted = set()

    def _after_turn(self) -> None:
        if self._stop:
            later = self._order > self._stop
            signalled = (script.signalled for script in self._manager.alive_scripts if _is_main(script))
            before = (script.signalled for script in self._alive if script.alive and _is_main(script))
            self._check(all(before if later else signalled), "a stop does not end the script")
            self._starts = [order for order in self._starts if order > self._stop]
            self._stop = 0
        if not self._pending:
            self._starts = []
        self._known, self._arriving = self._state, []
        newest = self._manager.newest
        if newest is not None and newest.alive:
            self._check(not self._run_is_over(newest), "a script goes on though its run is over")
        ended = {script for script in self._alive if not script.running}
        for script in ended:
            if _is_main(script):
                connected = self._manager.connection is not None and self._manager.connection._present
                self._check(not connected or script.run in self._halted, "no zero follows the end of a script")
        self._alive = {script for script in self._mine if script.running}

    @property
    def _pending(self) -> bool:
        service = self._manager.service
        return service is not None and service._runner._next is not None  # type: ignore[attr-defined]

    def _spawned(self, script: Script) -> None:
        self._mine.append(script)
        others = [other for other in self._manager.alive_scripts if other is not script and other.run != script.run]
        self._check(not others, "scripts of two starts are alive")
        twice = [other for other in self._manager.alive_scripts if other is not script and other.file == script.file]
        self._check(not twice, "a script is alive twice")
        if not _is_main(script):
            return
        self._check(bool(self._starts), "a script starts that nobody has asked for since the last stop")
        self._starts.pop(0)
        self._check(script.run > self.newest_run, "the number of a run does not grow")
        self.newest_run = script.run
        self._baselines = [self._known, *self._arriving]
        free = (state is None or not state.latched for state in self._baselines)
        self._check(any(free), "a script starts while the robot is stopped")

    # -- parts

    def _note_life(self) -> None:
        if self._life != self._manager.lives:
            self._life = self._manager.lives
            self._state = self._known = None
            self._arriving, self._baselines = [], []
            self._starts, self._stop, self._mine, self._alive = [], 0, [], set()

    def _command(self, message: Message) -> None:
        try:
            command: AutonomyCommand = codec.decode(AUTONOMY_COMMAND, message.payload)
        except PayloadError:
            return
        self._order += 1
        if command.action == _STOP:
            self._stop = self._order
        elif command.action == _START and command.file in NAMES:
            self._starts.append(self._order)

    def _run_is_over(self, script: Script) -> bool:
        state = self._state
        if state is None or script.signalled:
            return False
        barred = state.last_barred >= script.run
        same = (one is None or (state.boot, state.count) == (one.boot, one.count) for one in self._baselines)
        return state.latched or barred or not any(same)


def _is_main(script: Script) -> bool:
    """Whether it is not there because another one needs it."""
    return "needed" not in script.file
