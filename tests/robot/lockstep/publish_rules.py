"""What a script that uses the script API may publish, said of what it wants and of what it has received."""

from __future__ import annotations

from pebble.contract.payloads import Drive
from pebble.extensions.operator.client.robot_estop import RobotEstop
from tests.robot.lockstep.scheduler import Scheduler


class PublishRules:
    """The rules of one run."""

    def __init__(self, run: int, scheduler: Scheduler) -> None:
        self._run, self._check = run, scheduler.check
        self._times: list[float] = []
        self._wanted: set[tuple[float, float]] = set()  # since the newest zero
        self._last_is_zero = True
        self._refused = False
        self._ended = False

    def wants_to_drive(self, x: float, z: float) -> None:
        self._wanted.add((x, z))

    def wants_zero(self, *, waits: bool) -> None:
        """It has called for a zero; ``waits``: its run goes on, so nothing else explains why it was not published."""
        self._wanted.clear()
        self._check(self._last_is_zero or not waits, "a script's zero waits")

    def publishes(self, command: Drive, now: float) -> None:
        self._check(command.signed and command.run == self._run, "a script's command is not signed with its run")
        self._last_is_zero = not command.moves
        if not command.moves:
            return
        self._check(not self._ended, "a script moves the robot after its end")
        self._check((command.x, command.z) in self._wanted, "a script's command is published after a later zero")
        self._check(not self._refused, "a script moves a robot that is stopped, or that has ended its run")
        self._times = [at for at in self._times if now - at < 1.0] + [now]
        self._check(len(self._times) <= 50, "a script publishes more than 50 commands a second")

    def receives(self, estop: RobotEstop) -> None:
        self._refused = any(state.latched or state.last_barred >= self._run for state in estop.states.values())

    def has_ended(self) -> None:
        self._ended = True
