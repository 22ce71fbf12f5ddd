"""A robot and the operator who drives it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack, closing
from typing import Final, Self

from pebble.bench.bridge_drive import RATE_HZ, Arrived, DriveSegment, all_arrived, arrivals, arrived_of, matched
from pebble.bench.bridge_operator import Operator
from pebble.bench.usage import cpu_s
from pebble.errors import PebbleError
from pebble.rig.processes import python
from pebble.rig.robot import BASE, Robot, one_robot, synthetic_media

STAND_IN = "paho"  # two plain paho programs in place of a robot of ours: see stand_in
_MEDIA: Final = synthetic_media((1920, 1080, 30), (640, 360, 15))
_ARRIVE_S = 1.0  # commands and reports that take longer count as lost
_POLL_S = 0.1


class DrivenRobot:
    """Starts both in ``with``; both are ready when :meth:`wait` returns. The robot forwards its MCU's reports."""

    def __init__(self, kind: str, *, media: bool = False) -> None:
        self.kind, self._media = kind, media

    def __enter__(self) -> Self:
        """Raises PebbleError if something does not start."""
        with ExitStack() as stack:
            make, services = StandIn if self.kind == STAND_IN else Robot, _MEDIA if self._media else {}
            self.robot = stack.enter_context(one_robot(self.kind, make, services=services, reports=True))
            self.robot.launch()
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
        pids = self.robot.pids()
        began, used = time.monotonic_ns(), cpu_s(pids)
        sent = self.operator.drive(seconds, rate_hz, work_us=work_us, slowed=slowed)
        return DriveSegment(began, time.monotonic_ns(), sent, cpu_s(pids) - used)

    def match_arrivals(self, segments: Sequence[DriveSegment]) -> list[Arrived]:
        """Waits for the last commands and reports, or until they count as lost; returns one result for each segment."""
        since = min(segment.began for segment in segments)
        end = time.monotonic() + _ARRIVE_S
        while True:
            late = time.monotonic() > end
            entries = self.robot.lines(since)
            commands, reports = arrivals(entries), matched(entries, self.operator.received(since))
            if late or all_arrived(segments[-1], commands, reports):
                return [arrived_of(segment, commands, reports) for segment in segments]
            time.sleep(_POLL_S)


class StandIn(Robot):
    """What a user would have without us."""

    def launch(self) -> None:
        local = 0 if self.local_broker is None else self.local_broker.port
        rest = (local, self.remote_port, self.base, self.port, *(["--reports"] if self.reports else []))
        for part in ("bridge", "serial"):
            self.start(f"the stand-in's {part}", python("pebble.bench.stand_in", part, *rest))
