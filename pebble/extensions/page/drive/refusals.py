"""The reasons why a page's request to a robot is refused now, in words for people; "" if it is not refused."""

import time
from collections.abc import Callable

from pebble.extensions.operator.client.assumed import PARKED
from pebble.extensions.operator.client.broker import Broker
from pebble.extensions.operator.client.drive_reasons import (
    SCRIPT_ORDER,
    SERVER_ORDER,
    Code,
    Situation,
    first_reason,
    words,
)
from pebble.extensions.operator.client.named_topics import why_not
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.extensions.page import messages as m
from pebble.extensions.page import robot_commands


class Refusals:
    """The refusals of one server. ``moved_by`` returns who moves a component; ``robot_of`` returns its view."""

    def __init__(
        self, broker: Broker, moved_by: Callable[[str], str], robot_of: Callable[[str], RobotView | None]
    ) -> None:
        self._broker, self._moved_by, self._robot_of = broker, moved_by, robot_of
        #: Whether a stop is sent to a component that cannot latch it.
        self.is_stopping: Callable[[str], bool] = lambda _ref: False

    def of_driving(self, ref: str) -> str:
        """Return why no page may move this component; empty if one may."""
        robot = self._robot_of(ref) or RobotView(ref)
        why = self._words(robot, first_reason(self._situation(robot), SERVER_ORDER)) or self.nameless(robot)
        if not why and robot.parked:
            return PARKED
        return why

    def nameless(self, robot: RobotView) -> str:
        """Return the problem with this server's account, if the robot requires one in topics; empty if none."""
        return why_not(robot.name, self._broker.names.account) if robot.named else ""

    def of_op(self, op: m.RobotOp) -> str:
        """Return why this request is not sent to a robot now. Requests that end something are always sent."""
        robot = self._robot_of(op.ref)
        if robot is None:
            return "unknown component"
        if robot_commands.ends(op):
            return "" if self._broker.connected else "The server cannot reach the broker"
        order = (Code.BROKER,) if isinstance(op, m.FlagOp) else (Code.BROKER, Code.SILENT)  # a broker remembers flags
        why = self._words(robot, first_reason(self._situation(robot), order))
        why = why or self.nameless(robot) or robot_commands.refusal(op, robot.capabilities)
        if not why and isinstance(op, m.AutonomyOp):
            return self._of_script(robot)
        return why

    def _of_script(self, robot: RobotView) -> str:
        """Return why no script may be started now."""
        by = self._moved_by(robot.base)
        situation = self._situation(robot)._replace(driven=bool(by) and not robot.arbitrates)
        code = first_reason(situation, SCRIPT_ORDER)
        return "Stopped: reset it first" if code is Code.STOPPED else words(code, robot.name, driven=by)

    def _situation(self, robot: RobotView) -> Situation:
        stopping = self.is_stopping(robot.base)
        return robot.situation(time.monotonic())._replace(problem=self._broker.problem, stopping=stopping)

    def _words(self, robot: RobotView, code: Code | None) -> str:
        return words(code, robot.name, stopped=robot.stopped_by, problem=self._broker.problem)
