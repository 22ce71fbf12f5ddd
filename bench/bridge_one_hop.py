"""The lower bound: the same commands to a stock client, one hop through a stock broker without other traffic."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack, closing
from typing import Self

from pebble.bench.bridge_drive import RATE_HZ, Arrived, DriveSegment
from pebble.bench.bridge_operator import Operator, Wheels
from pebble.bench.bridge_subscriber import CommandSubscriber
from pebble.contract import DRIVE
from pebble.rig.processes import Processes

HOP = "one hop"
_BASE = "pebble/robots/one-hop"
_ARRIVE_S = 1.0
_POLL_S = 0.02


class OneHop:
    """Has the same methods as :class:`DrivenRobot`."""

    kind = HOP

    def __enter__(self) -> Self:
        """Raises PebbleError if something does not start."""
        with ExitStack() as stack:
            processes = stack.enter_context(Processes())
            broker = processes.broker("hop")
            broker.wait()
            self._subscriber = CommandSubscriber(processes, broker.port, DRIVE.topic(_BASE))
            self._operator = stack.enter_context(closing(Operator(broker.port, _BASE)))
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def drive(self, seconds: float) -> DriveSegment:
        began = time.monotonic_ns()
        sent = self._operator.drive(seconds, RATE_HZ)
        return DriveSegment(began, time.monotonic_ns(), sent)

    def match_arrivals(self, segments: Sequence[DriveSegment]) -> list[Arrived]:
        """See :meth:`DrivenRobot.match_arrivals`."""
        received: dict[Wheels, int] = {}
        end = time.monotonic() + _ARRIVE_S
        while True:
            late = time.monotonic() > end
            received |= self._subscriber.received()
            if late or list(segments[-1].sent)[-1] in received:
                return [_found(segment, received) for segment in segments]
            time.sleep(_POLL_S)


def _found(segment: DriveSegment, received: dict[Wheels, int]) -> Arrived:
    down = [(received[speeds] - sent) / 1e6 for speeds, sent in segment.sent.items() if speeds in received]
    return Arrived(down, sent=len(segment.sent))
