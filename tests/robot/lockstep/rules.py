"""What must hold at the wheels and of scripts, said of what arrived and when; independent of how it is achieved.

At the end of each turn of the motor owner:

* The wheels turn only by a live command that a person or a script has published, that arrived in this life of the owner
  at most 0.5 s before it was judged, and whose deadline, at most 0.75 s after its arrival, is not over.
* After a person's zero only by a command that arrived later.
* By a script only if no person has commanded anything within the last 2 s, if the owner has been up for 2 s, if no
  newer run has been received, and if no person has stopped this run: by a zero while it moved the wheels, by a final
  zero, by a connection that was lost while the person drove, or by an emergency stop.
* After a zero of the script, not by an earlier command of its run.
* Not at all between an emergency stop and a reset of exactly this stop.

While nothing turns the owner, the MCU's own deadline of 1 s stops the wheels.
"""

from __future__ import annotations

from typing import Any

from pebble.contract import DRIVE, ESTOP, ESTOP_RESET, codec
from pebble.contract.payloads import Drive, EstopCommand, EstopReset
from pebble.errors import PayloadError
from pebble.transports import Message
from tests.robot.lockstep.commands import PERSON, Command, Commands
from tests.robot.lockstep.owner import DEADMAN_S, Owner
from tests.robot.lockstep.scheduler import Scheduler

WATCHDOG_S, HOLD_S, START_S, INBOX_S, RESET_S = 0.75, 2.0, 2.0, 0.5, 1.0
_MS = 0.002  # the arbiter counts whole milliseconds


class WheelRules:
    """The rules of the motor owner; ``arrived`` is called with what its transport delivers."""

    def __init__(self, owner: Owner, commands: Commands, scheduler: Scheduler) -> None:
        self._owner, self._commands, self._clock, self._check = owner, commands, scheduler.clock, scheduler.check
        self._order = 0
        self.stopped = 0  # runs up to this number never move anything again
        self.seen: set[int] = set()  # runs that have moved the wheels
        self._life = 0
        self._begin()
        owner.before, owner.after = self.before_turn, self.after_turn

    def _begin(self) -> None:
        """A new life of the owner; what is stopped stays so."""
        self._life = self._owner.lives
        self.since = self._owner.started_at
        self.newest = 0
        self.latched = getattr(self, "latched", False)
        self._count = 0
        self._names: list[str] = getattr(self, "_names", [])
        self._zero_order = -1
        self._person_at: float | None = None
        self._lost_from: float | None = None  # a person's command that was not followed by a zero yet
        self._lost = 0  # the newest run that this may end
        self._batch: list[tuple[int, Any]] = []
        self._turning: Command | None = None
        self._checked_at = self.since

    # -- what happens

    def arrived(self, message: Message) -> None:
        """A message is delivered to the owner."""
        if message.retain:
            return
        channel = next((c for c in (DRIVE, ESTOP, ESTOP_RESET) if message.topic.endswith(f"/{c.metric}")), None)
        if channel is None:
            return
        if self._life != self._owner.lives:
            self._begin()
        try:
            value = codec.decode(channel, message.payload)
        except PayloadError:
            return
        self._order += 1
        self._batch.append((self._order, value))
        if isinstance(value, Drive) and value.moves:
            command = self._commands.find(value.x, value.z)
            if command is not None:
                command.arrived, command.order = self._clock(), self._order
        elif isinstance(value, EstopReset):
            self._batch[-1] = (self._order, (value, self._clock()))

    def before_turn(self) -> None:
        """What the wheels have done since the last turn."""
        if self._life != self._owner.lives:
            self._begin()
        self.lapse()
        command = self._current()
        if command is not None and command is self._turning:
            late = self._clock() - self._deadline(command)
            self._check(
                late <= self._owner.slack + _MS or self._was_frozen(), "a wheel turns after its command's deadline"
            )

    def after_turn(self) -> None:
        """The owner has judged everything that had arrived."""
        batch, self._batch = self._batch, []
        now = self._clock()
        stops: list[EstopCommand] = []
        for order, value in batch:
            if isinstance(value, EstopCommand):
                if value not in stops:  # equal ones that wait together are one
                    stops.append(value)
                    self._stop(value)
            elif isinstance(value, tuple):
                self._reset(value[0], value[1], now)
            elif not value.moves:
                self._zero(order, value)
        for _, value in batch:
            if isinstance(value, Drive) and value.signed and isinstance(value.run, int):
                self._note_run(value.run)
        for _, value in batch:
            if isinstance(value, Drive) and not value.signed and not value.moves:
                self._person(now, moves=False)
        command = self._current()
        if command is not None:
            if command is not self._turning or self._owner.wheels.at == now:
                command.judged = self._owner.wheels.at
            self._judge(command, now)
        if command is not None and command.run == PERSON and command.judged == now:
            self._person(now, moves=True)
        self._turning = command
        self._checked_at = now

    def lapse(self) -> None:
        """A person who drove, and then sent nothing for 2 s, has lost the connection: the runs so far are over."""
        silent_s = -1.0 if self._lost_from is None else self._clock() - self._lost_from
        if silent_s < HOLD_S - _MS:
            self._lost = self.newest
        elif silent_s >= HOLD_S + _MS:
            self._lost_from = None
            self._end_runs(self._lost)

    def turning(self) -> Command | None:
        """The command by which the wheels turn now."""
        return self._current()

    # -- parts

    def _current(self) -> Command | None:
        speeds = self._owner.wheels.speeds
        if speeds is None:
            return None
        command = self._commands.of(speeds)
        self._check(command is not None, "the wheels turn by a command that nobody has published")
        return command

    def _was_frozen(self) -> bool:
        """Whether the owner could not have stopped the wheels in time."""
        return self._owner.frozen_at >= self._owner.wheels.at or self._clock() - self._owner.wheels.at >= DEADMAN_S

    def _deadline(self, command: Command) -> float:
        return command.arrived + min(command.valid_s, WATCHDOG_S)

    def _zero(self, order: int, value: Drive) -> None:
        if not value.signed:
            self._zero_order = order
            in_effect = self._turning is not None and self._turning.run != PERSON
            if value.valid_ms == 0 or (in_effect and self._turning is self._current_before()):
                self._end_runs()
            self._lost_from = None
        elif self._turning is not None and self._turning.run == value.run and self._turning.order < order:
            current = self._current()
            held = self.latched or (self._person_at is not None and self._clock() - self._person_at < HOLD_S)
            self._check(
                held or value.run < self.newest or current is None or current.run != value.run or current.order > order,
                "a script's zero does not stop its wheels",
            )

    def _current_before(self) -> Command | None:
        """What moved the wheels before this turn, unless its deadline was over."""
        command = self._turning
        return command if command is not None and self._clock() < self._deadline(command) else None

    def _person(self, now: float, *, moves: bool) -> None:
        self._person_at = now
        self._lost_from = now if moves else None

    def _note_run(self, run: int) -> None:
        self.newest = max(self.newest, run)
        if self.latched:
            self._end_runs()

    def _stop(self, value: EstopCommand) -> None:
        name = value.stop if isinstance(value.stop, str) else ""
        if name in self._names and name:
            return
        self._names = [name, *self._names][:8]
        self._count += 1
        self.latched = True
        self._end_runs()

    def _reset(self, reset: EstopReset, arrived: float, now: float) -> None:
        newest = reset.boot == self._owner.boot and reset.count == self._count
        if newest and now - arrived < RESET_S:
            self.latched = False

    def _end_runs(self, newest: int | None = None) -> None:
        self.stopped = max(self.stopped, self.newest if newest is None else newest)

    def _judge(self, command: Command, now: float) -> None:
        self._check(command.may_move, "a retained or malformed command moves the wheels")
        self._check(not self.latched, "a wheel turns while its owner is latched")
        self._check(command.arrived >= self.since, "a command that arrived in an earlier life moves the wheels")
        if command.judged == now:  # else it has waited in the line until that was ready
            self._check(now - command.arrived <= INBOX_S + _MS, "a command that is too old moves the wheels")
        self._check(
            now <= self._deadline(command) + self._owner.slack + _MS, "a wheel turns after its command's deadline"
        )
        self._check(command.order > self._zero_order, "a wheel turns after a person's zero by an earlier command")
        if command.run == PERSON:
            return
        self.seen.add(command.run)
        self._check(command.run > self.stopped, "a run moves the wheels that a person has stopped")
        self._check(command.run >= self.newest, "an older run moves the wheels")
        held = self._person_at is not None and command.judged - self._person_at < HOLD_S - _MS
        self._check(not held, "a script moves the wheels while a person drives")
        self._check(
            command.judged - self.since >= START_S - _MS, "a script moves the wheels of an owner that just started"
        )
