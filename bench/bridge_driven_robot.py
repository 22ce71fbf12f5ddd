"""A robot and the operator who drives it."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack, closing
from typing import Self

from pebble.bench.bridge_drive import RATE_HZ, Arrived, DriveSegment, drive, match_arrivals
from pebble.bench.bridge_operator import Operator
from pebble.bench.bridge_robot import BASE, RobotProcesses
from pebble.errors import PebbleError


class DrivenRobot:
    """Starts both in ``with``; both are ready when :meth:`wait` returns."""

    def __init__(self, kind: str, *, media: bool = False) -> None:
        self.kind = kind
        self.robot = RobotProcesses(kind, media=media, reports=True)

    def __enter__(self) -> Self:
        """Raises PebbleError if something does not start."""
        with ExitStack() as stack:
            stack.enter_context(self.robot)
            self.operator = stack.enter_context(closing(Operator(self.robot.remote_port, BASE)))
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def wait(self) -> None:
        """Raises PebbleError with the robot's log if it does not become ready."""
        try:
            self.operator.wait_until_ready()
        except PebbleError as error:
            raise PebbleError(f"{self.kind}: {error}\n{self.robot.log()}") from None

    def drive(
        self, seconds: float, rate_hz: float = RATE_HZ, *, work_us: float = 0.0, slowed: bool = False
    ) -> DriveSegment:
        """See :meth:`Operator.drive`."""
        return drive(self.robot, self.operator, seconds, rate_hz, work_us=work_us, slowed=slowed)

    def match_arrivals(self, segments: Sequence[DriveSegment]) -> list[Arrived]:
        return match_arrivals(self.robot, self.operator, segments)
