"""Which robots people have taken from the demo's operator: driven from a page, or stopped. Pure."""

import math
from contextlib import suppress

from pebble.client.driver_lease import VALID_S
from pebble.client.robot_view import RobotView
from pebble.contract import DRIVING, codec
from pebble.errors import PayloadError
from pebble.transports import Message


class Visitors:
    """A robot that a person has had is free again in the step after. Times are seconds of one monotonic clock."""

    def __init__(self, name: str) -> None:
        """``name``: that of the operator, whose own stops are none of a person."""
        self.left_alone: set[str] = set()  # names of robots that were found to be taken
        self._name = name
        self._driven: dict[str, tuple[str, float]] = {}  # by base topic: who drives it from the page, announced when
        self._step_began = 0.0

    def receive(self, message: Message, now: float) -> None:
        """A server announces once a second which robots are driven; what the broker retained is older."""
        if message.retain:
            return
        with suppress(PayloadError):
            for base, driver in codec.decode(DRIVING, message.payload).robots.items():
                who = f"{driver.by} on {driver.device}" if driver.device else driver.by
                self._driven[base] = who, now

    def begin_step(self, now: float) -> None:
        """What people had before no longer counts."""
        self._step_began = now

    def taken(self, robot: RobotView, now: float) -> str:
        """Why people have the control of it now; empty: they have not."""
        if robot.controlled and robot.control.who:  # as it tells itself
            self._driven[robot.base] = robot.control.who, now
        who, at = self._driven.get(robot.base, ("", -math.inf))
        if robot.control.who if robot.controlled else now - at < VALID_S:
            return f"is driven by {who}"
        stop = robot.stopped_by
        return "" if stop is None or stop.by == self._name else f"is stopped by {stop.by or 'unknown'}"

    def free(self, robot: RobotView, now: float) -> bool:
        """Whether it may be driven in the present step, in which no person has had it so far."""
        _, at = self._driven.get(robot.base, ("", -math.inf))
        if at < self._step_began and not self.taken(robot, now):
            return True
        self.left_alone.add(robot.name)
        return False
