"""What the operator of ``pebble bench bridge`` drives: a whole robot, the stand-in, or one hop to a stock client."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from typing import Final

from pebble.bench.bridge_operator import (
    RATE_HZ,
    Arrived,
    DriveSegment,
    Operator,
    Reports,
    Wheels,
    all_arrived,
    arrivals,
    arrived_of,
    matched,
)
from pebble.bench.subscribers import RobotSubscriber
from pebble.bench.usage import cpu_s
from pebble.contract import DRIVE
from pebble.errors import PebbleError
from pebble.rig.processes import Processes, python
from pebble.rig.robot import BASE, Robot, synthetic_media
from pebble.services.serial_mcu_bridge.text.goob_base import Touch

STAND_IN, HOP = "paho", "one hop"  # paho: two plain programs in place of a robot of ours, see stand_in
FORWARDER, SERIAL = "bridge", "serial bridge"
FLOWS = ("frames", "video", "audio")
_SERVICES = {FORWARDER: "mqtt_bridge", SERIAL: "serial_mcu_bridge"}
_PROGRAMS = "pebble.bench.bridge_operator"
_MEDIA: Final = synthetic_media((1920, 1080, 30), (640, 360, 15))
_HOP_BASE = "pebble/robots/one-hop"
_UP_S, _FLOW_S, _STOP_S = 30.0, 20.0, 10.0
_ANSWER_S = 5.0
_ARRIVE_S = 1.0  # commands and reports that take longer count as lost
_POLL_S = 0.05

Arrivals = tuple[Mapping[Wheels, int], Reports, Sequence[tuple[int, Touch]]]
"""When each command arrived; the reports; and all reports that were received."""


class Driven(Processes):
    """What is driven, and its operator: starts both in ``with``; both are ready when :meth:`wait` returns."""

    operator: Operator

    def wait(self) -> None:
        """Raises PebbleError if it does not become ready."""

    def drive(
        self, seconds: float, rate_hz: float = RATE_HZ, *, work_us: float = 0.0, slowed: bool = False
    ) -> DriveSegment:
        """See :meth:`Operator.drive`."""
        began = time.monotonic_ns()
        sent = self.operator.drive(seconds, rate_hz, work_us=work_us, slowed=slowed)
        return DriveSegment(began, time.monotonic_ns(), sent)

    def match_arrivals(self, segments: Sequence[DriveSegment]) -> list[Arrived]:
        """Waits for the last commands and reports, or until they count as lost; returns one result for each segment."""
        since, end = min(segment.began for segment in segments), time.monotonic() + _ARRIVE_S
        while True:
            late = time.monotonic() > end
            commands, reports, received = self._arrivals(since)
            if late or all_arrived(segments[-1], commands, reports):
                return [arrived_of(segment, commands, reports, received) for segment in segments]
            time.sleep(_POLL_S)

    def _arrivals(self, since: int) -> Arrivals:
        raise NotImplementedError


class DrivenRobot(Driven):
    """A whole robot. With ``reports`` it forwards those of its MCU."""

    def __init__(self, kind: str, *, media: bool = False, reports: bool = True) -> None:
        super().__init__()
        self.kind, self._media, self._reports = kind, media, reports
        self._parts: Mapping[str, int] = {}

    def start(self) -> None:
        """Raises PebbleError if something does not start."""
        make, services = StandIn if self.kind == STAND_IN else Robot, _MEDIA if self._media else {}
        broker = self.broker("remote")
        self.rover = make(self, self.kind, ("127.0.0.1", broker.port), services=services, reports=self._reports)
        broker.wait()
        self.rover.prepare()
        self.rover.launch()
        self.operator = Operator(broker.port, BASE)
        self.closing.callback(self.operator.close)

    def wait(self) -> None:
        with closing(RobotSubscriber(self.rover.remote_port, BASE)) as subscriber:
            self.rover.expect(
                lambda: subscriber.ready_ns is not None and subscriber.first_heartbeat_ns is not None,
                f"{self.kind}: the robot is not ready", _UP_S,
            )  # fmt: skip
        running = self.rover.processes()
        if missing := [name for name in _SERVICES.values() if name not in running]:
            raise self.problem(f"{' and '.join(missing)} is not running")
        self._parts = {part: running[name] for part, name in _SERVICES.items()}

    def drive(
        self, seconds: float, rate_hz: float = RATE_HZ, *, work_us: float = 0.0, slowed: bool = False
    ) -> DriveSegment:
        """See :meth:`Operator.drive`. Raises PebbleError if one of the two bridges has ended."""
        pids = self.rover.pids()
        used, before = cpu_s(pids), self._parts_cpu_s()
        segment = super().drive(seconds, rate_hz, work_us=work_us, slowed=slowed)
        parts = {part: after - before[part] for part, after in self._parts_cpu_s().items()}
        if ended := [part for part, used_s in parts.items() if used_s <= 0]:
            raise self.problem(f"the {' and the '.join(ended)} ended while it was driven")
        return replace(segment, cpu_s=cpu_s(pids) - used, parts_cpu_s=parts)

    def _parts_cpu_s(self) -> dict[str, float]:
        return {part: cpu_s([pid]) for part, pid in self._parts.items()}

    def _arrivals(self, since: int) -> Arrivals:
        entries, received = self.rover.lines(since), self.operator.received(since)
        return arrivals(entries), matched(entries, received), received

    def problem(self, what: str) -> PebbleError:
        """An error with the robot's log."""
        return PebbleError(f"{self.kind}: {what}\n{self.rover.log()}")

    @contextmanager
    def media_load(self) -> Iterator[Callable[[], dict[str, int]]]:
        """Puts its camera and microphone in use: a program on the robot reads frames, an operator gets both.

        All media flow as the ``with`` block begins, and stop with it. It is given what counts the received frames and
        packets so far, by flow. Raises PebbleError naming what does not flow.
        """
        robot, before = self.rover, len(self.rover.pids())
        workers = [
            self.worker("frame reader", _PROGRAMS, "frames", robot.run_dir),
            self.worker("media operator", _PROGRAMS, "media", robot.remote_port, robot.base),
        ]

        def counts() -> dict[str, int]:
            for worker in workers:
                worker.send("")
            found = {name: count for worker in workers for name, count in worker.answer(_ANSWER_S).items()}
            return {name: found.get(name, 0) for name in FLOWS}

        try:
            self.operator.media(True)
            end = time.monotonic() + _FLOW_S
            while missing := [name for name, count in counts().items() if not count]:
                if time.monotonic() > end:
                    raise self.problem(f"no {', '.join(missing)} after {_FLOW_S:.0f} s")
                time.sleep(_POLL_S)
            yield counts
        finally:
            self.operator.media(False)
            for worker in workers:
                self.end(worker)
            end = time.monotonic() + _STOP_S
            while len(robot.pids()) > before and time.monotonic() < end:
                time.sleep(_POLL_S)


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


class OneHop(Driven):
    """The lower bound: the same commands to a stock client, one hop through a stock broker without other traffic."""

    def start(self) -> None:
        """Raises PebbleError if something does not start."""
        broker = self.broker("hop")
        broker.wait()
        self._subscriber = self.worker("the subscriber", _PROGRAMS, "hop", broker.port, DRIVE.topic(_HOP_BASE))
        self.operator = Operator(broker.port, _HOP_BASE)
        self.closing.callback(self.operator.close)
        self._received: dict[Wheels, int] = {}

    def wait(self) -> None:
        """Raises PebbleError if its client does not subscribe."""
        self._subscriber.answer(_UP_S)

    def _arrivals(self, _since: int) -> Arrivals:
        new = self._subscriber.ask("", _ANSWER_S)["received"]
        self._received |= {(left, right): ns for left, right, ns in new}
        return self._received, [], []
