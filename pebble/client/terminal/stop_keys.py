"""The emergency stop of one terminal: ! or Escape twice, and what became of the newest one."""

from pebble.client.estop import Progress, StopSender, new_name
from pebble.client.robot_view import RobotView
from pebble.client.terminal.key_decoder import ESCAPE
from pebble.transports import Message

TWICE_S = 0.6  # between two presses of Escape


class StopKeys:
    """``by``: who presses them, for the robot. Publish what :meth:`stop` and :meth:`tick` return."""

    def __init__(self, robot: RobotView, by: str) -> None:
        self._robot, self._by = robot, by
        self._escape_at = float("-inf")
        self.newest: StopSender | None = None

    def pressed(self, key: str, now: float) -> bool:
        """Whether this key asks for a stop."""
        twice = key == ESCAPE and now - self._escape_at <= TWICE_S
        if key == ESCAPE:
            self._escape_at = now
        return key == "!" or twice

    def stop(self, now: float) -> list[Message]:
        """Begin a stop, unless one is being sent."""
        if self.sending:
            return []
        self.newest = StopSender(new_name(), by=self._by, why="", now=now, robots=[self._robot.base])
        for message in self._robot.remembered.values():
            self.newest.receive(message, now)
        return self.newest.tick(now)

    def receive(self, message: Message, now: float) -> None:
        if self.newest is not None:
            self.newest.receive(message, now)

    def tick(self, now: float) -> list[Message]:
        return [] if self.newest is None else self.newest.tick(now)

    @property
    def sending(self) -> bool:
        return self.newest is not None and not self.newest.finished

    @property
    def unconfirmed(self) -> bool:
        return self.newest is not None and not self.newest.confirmed

    def text(self) -> str:
        """How far it is, else nothing: the reason against driving names another one."""
        if self.newest is None or not self.newest.robots:
            return ""
        stop = self.newest.robots[self._robot.base]
        if stop.progress is Progress.CONFIRMED:
            return "" if stop.estop.latched else "it was reset since"
        return f"EMERGENCY STOP {'sent, ' if stop.sending else ''}NOT CONFIRMED: {stop.why}"
