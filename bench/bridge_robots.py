"""What the operator of ``pebble bench bridge`` drives: a whole robot, the stand-in, or one hop to a stock client."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from typing import Final, Self

from pebble.bench.bridge_operator import (
    RATE_HZ,
    Arrived,
    DriveSegment,
    Operator,
    Wheels,
    all_arrived,
    arrivals,
    arrived_of,
    matched,
)
from pebble.bench.usage import cpu_s
from pebble.contract import DRIVE
from pebble.errors import PebbleError
from pebble.rig.processes import Processes, python
from pebble.rig.programs import Worker
from pebble.rig.robot import BASE, Robot, one_robot, synthetic_media

STAND_IN, HOP = "paho", "one hop"  # paho: two plain programs in place of a robot of ours, see stand_in
FORWARDER, SERIAL = "bridge", "serial bridge"
FLOWS = ("frames", "video", "audio")
_SERVICES = {FORWARDER: "mqtt_bridge", SERIAL: "serial_mcu_bridge"}
_PROGRAMS = "pebble.bench.bridge_operator"
_MEDIA: Final = synthetic_media((1920, 1080, 30), (640, 360, 15))
_HOP_BASE = "pebble/robots/one-hop"
_START_S, _STOP_S = 20.0, 10.0
_ANSWER_S = 5.0
_ARRIVE_S = 1.0  # commands and reports that take longer count as lost
_POLL_S, _HOP_POLL_S = 0.1, 0.02


class StandIn(Robot):
    """What a user would have without us."""

    def launch(self) -> None:
        local = 0 if self.local_broker is None else self.local_broker.port
        rest = (local, self.remote_port, self.base, self.port, *(["--reports"] if self.reports else []))
        for part in ("bridge", "serial"):
            self.start(f"the stand-in's {part}", python("pebble.bench.stand_in", part, *rest))

    def processes(self) -> dict[str, int]:
        """Its two programs, by the names of the services that they stand for."""
        return {name: one.pid for name, one in zip(_SERVICES.values(), self._started, strict=False)}


class DrivenRobot:
    """A robot and its operator: starts both in ``with``; both are ready when :meth:`wait` returns.

    With ``reports`` it forwards those of its MCU.
    """

    def __init__(self, kind: str, *, media: bool = False, reports: bool = True) -> None:
        self.kind, self._media, self._reports = kind, media, reports
        self._parts: Mapping[str, int] = {}

    def __enter__(self) -> Self:
        """Raises PebbleError if something does not start."""
        with ExitStack() as stack:
            make, services = StandIn if self.kind == STAND_IN else Robot, _MEDIA if self._media else {}
            self.robot = stack.enter_context(one_robot(self.kind, make, services=services, reports=self._reports))
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
            raise self._problem(str(error)) from None
        running = self.robot.processes()
        if missing := [name for name in _SERVICES.values() if name not in running]:
            raise self._problem(f"{' and '.join(missing)} is not running")
        self._parts = {part: running[name] for part, name in _SERVICES.items()}

    def drive(
        self, seconds: float, rate_hz: float = RATE_HZ, *, work_us: float = 0.0, slowed: bool = False
    ) -> DriveSegment:
        """See :meth:`Operator.drive`. Raises PebbleError if one of the two bridges has ended."""
        pids = self.robot.pids()
        began, used, before = time.monotonic_ns(), cpu_s(pids), self._parts_cpu_s()
        sent = self.operator.drive(seconds, rate_hz, work_us=work_us, slowed=slowed)
        parts = {part: after - before[part] for part, after in self._parts_cpu_s().items()}
        segment = DriveSegment(began, time.monotonic_ns(), sent, cpu_s(pids) - used, parts)
        if ended := [part for part, used_s in parts.items() if used_s <= 0]:
            raise self._problem(f"the {' and the '.join(ended)} ended while it was driven")
        return segment

    def match_arrivals(self, segments: Sequence[DriveSegment]) -> list[Arrived]:
        """Waits for the last commands and reports, or until they count as lost; returns one result for each segment."""
        since = min(segment.began for segment in segments)
        end = time.monotonic() + _ARRIVE_S
        while True:
            late = time.monotonic() > end
            entries, received = self.robot.lines(since), self.operator.received(since)
            commands, reports = arrivals(entries), matched(entries, received)
            if late or all_arrived(segments[-1], commands, reports):
                return [arrived_of(segment, commands, reports, received) for segment in segments]
            time.sleep(_POLL_S)

    def _parts_cpu_s(self) -> dict[str, float]:
        return {part: cpu_s([pid]) for part, pid in self._parts.items()}

    def _problem(self, what: str) -> PebbleError:
        return PebbleError(f"{self.kind}: {what}\n{self.robot.log()}")


class OneHop(Processes):
    """The lower bound: the same commands to a stock client, one hop through a stock broker without other traffic.

    Has the same methods as :class:`DrivenRobot`.
    """

    def start(self) -> None:
        """Raises PebbleError if something does not start."""
        broker = self.broker("hop")
        broker.wait()
        self._subscriber = self.worker("the subscriber", _PROGRAMS, "hop", broker.port, DRIVE.topic(_HOP_BASE))
        self._operator = Operator(broker.port, _HOP_BASE)
        self.closing.callback(self._operator.close)

    def wait(self) -> None:
        """Raises PebbleError if its client does not subscribe."""
        self._subscriber.answer(_START_S)

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
            new = self._subscriber.ask("", _ANSWER_S)["received"]
            received |= {(left, right): ns for left, right, ns in new}
            if late or list(segments[-1].sent)[-1] in received:
                return [arrived_of(segment, received, []) for segment in segments]
            time.sleep(_HOP_POLL_S)


@contextmanager
def media_load(driven: DrivenRobot) -> Iterator[Callable[[], dict[str, int]]]:
    """Puts a robot's camera and microphone in use: a program on the robot reads frames, an operator gets both.

    All media flow as the ``with`` block begins, and stop with it. It is given what counts the received frames and
    packets so far, by flow. Raises PebbleError naming what does not flow.
    """
    robot, before = driven.robot, len(driven.robot.pids())
    workers: list[Worker] = []

    def counts() -> dict[str, int]:
        for worker in workers:
            worker.send("")
        found = {name: count for worker in workers for name, count in worker.answer(_ANSWER_S).items()}
        return {name: found.get(name, 0) for name in FLOWS}

    try:
        workers.append(robot.running.worker("frame reader", _PROGRAMS, "frames", robot.run_dir))
        workers.append(robot.running.worker("media operator", _PROGRAMS, "media", robot.remote_port, robot.base))
        driven.operator.media(True)
        end = time.monotonic() + _START_S
        while missing := [name for name, count in counts().items() if not count]:
            if time.monotonic() > end:
                raise PebbleError(f"no {', '.join(missing)} after {_START_S:.0f} s\n{robot.log()}")
            time.sleep(_POLL_S)
        yield counts
    finally:
        driven.operator.media(False)
        for worker in workers:
            robot.running.end(worker)
        end = time.monotonic() + _STOP_S
        while len(robot.pids()) > before and time.monotonic() < end:
            time.sleep(_POLL_S)
