"""An operator who drives at a steady rate over MQTT, what is driven, and which commands and reports of its MCU arrived.

As processes beside the robot: ``python -m pebble.bench.bridge_operator WHAT …``. ``frames RUN_DIR`` reads a robot's
frames and ``media PORT BASE`` receives its video and sound; both answer every line with the counts so far. ``hop PORT
TOPIC`` is a stock client one hop from the operator: it writes one line once it is subscribed, and answers every line
with the commands since the last one.
"""

from __future__ import annotations

import json
import sys
import time
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from paho.mqtt.client import Client, MQTTMessage

from pebble.bench.null import spin
from pebble.bench.subscribers import RobotSubscriber
from pebble.bench.usage import cpu_s
from pebble.contract import (
    AUDIO,
    AUDIO_CONTROL,
    CAMERA,
    DRIVE,
    MQTT_AUDIO,
    MQTT_VIDEO,
    ONLINE,
    STATUS,
    TOUCH_SENSORS,
    VIDEO_CONTROL,
)
from pebble.errors import PebbleError
from pebble.rig.processes import Processes, python
from pebble.rig.robot import BASE, Robot, synthetic_media
from pebble.rig.stock_client import StockClient, steadily
from pebble.rig.worker_end import answer, serve, serve_on_thread
from pebble.services.serial_mcu_bridge.text.goob_base import Touch, parse
from pebble.simulation.trace import Entry

RATE_HZ = 20.0  # of an operator's commands
STAND_IN, HOP = "paho", "one hop"  # paho: two plain programs in place of a robot of ours, see stand_in
FORWARDER, SERIAL = "bridge", "serial bridge"
FLOWS = ("frames", "video", "audio")
_SERVICES = {FORWARDER: "mqtt_bridge", SERIAL: "serial_mcu_bridge"}
_MODULE = "pebble.bench.bridge_operator"
_MEDIA: Final = synthetic_media((1920, 1080, 30), (640, 360, 15))
_HOP_BASE = "pebble/robots/one-hop"
_DIGITS = 3  # of a wheel's speed on the serial line
_STEPS = 800  # wheel values 0.100 … 0.899
_REPORTS_LIMIT = 400_000  # reports; a robot sends 50 a second
_READ_S = 0.2
_EVERY = 16  # bytes: one in so many of a picture's is read
_UP_S, _FLOW_S, _STOP_S = 30.0, 20.0, 10.0
_ANSWER_S = 5.0
_ARRIVE_S = 1.0  # commands and reports that take longer count as lost
_POLL_S = 0.05

Wheels = tuple[float, float]
Reports = Sequence[tuple[int, int | None]]
"""When each report was sent, and when it was received; None: it was not."""
Arrivals = tuple[Mapping[Wheels, int], Reports, Sequence[tuple[int, Touch]]]
"""When each command arrived; the reports; and all reports that were received."""


class Operator(StockClient):
    """One MQTT connection to the remote broker. Each command is identified by the wheel speeds it causes.

    It uses the same TCP options as our own clients. TCP_NODELAY: see :class:`StockClient`. TCP_QUICKACK: otherwise a
    stock broker delays a report by up to 40 ms while its answer to a command is not acknowledged. Without them the
    comparison would measure that.
    """

    def __init__(self, port: int, base: str) -> None:
        self._base, self._number = base, 0
        self._received: deque[tuple[int, bytes | bytearray]] = deque(maxlen=_REPORTS_LIMIT)
        channels = (STATUS, ONLINE, TOUCH_SENSORS)
        super().__init__(lambda _: self.acknowledge(), [(channel.topic(base), 1) for channel in channels])
        self.paho.on_publish = lambda *_: self.acknowledge()
        self.paho.message_callback_add(TOUCH_SENSORS.topic(base), self._on_report)
        self.open(port)

    def media(self, wanted: bool) -> None:
        """Allows and requests video and audio, or stops both."""
        for flag in (MQTT_VIDEO, MQTT_AUDIO):
            self.send(flag, self._base, wanted)
        for request in (VIDEO_CONTROL, AUDIO_CONTROL):
            self.send(request, self._base, {"enabled": wanted})

    def drive(self, seconds: float, rate_hz: float, *, work_us: float = 0.0, slowed: bool = False) -> dict[Wheels, int]:
        """Returns the time (CLOCK_MONOTONIC, ns) at which the command for each pair of wheel speeds was published.

        It works for ``work_us`` before each: before it reads the clock, or, if ``slowed``, after that.
        """
        sent: dict[Wheels, int] = {}
        for _ in steadily(seconds, rate_hz):
            self._number += 1
            left, right = wheels(self._number)
            spin(0.0 if slowed else work_us)
            sent[left, right] = time.monotonic_ns()
            spin(work_us if slowed else 0.0)
            self.send(DRIVE, self._base, {"x": (left - right) / 2, "z": (left + right) / 2})
        return sent

    def received(self, since_ns: int) -> list[tuple[int, Touch]]:
        """The MCU's reports after ``since_ns``, each with its time of arrival."""
        return [(ns, Touch(**json.loads(payload)["value"])) for ns, payload in self._received.copy() if ns >= since_ns]

    def _on_report(self, _client: Client, _data: Any, message: MQTTMessage) -> None:
        self._received.append((time.monotonic_ns(), message.payload))
        self.acknowledge()


def wheels(number: int) -> Wheels:
    """The wheel speeds of command ``number`` (0 … 639,999): each pair is unique."""
    return round(0.1 + (number % _STEPS) / 1000, 3), round(0.1 + (number // _STEPS % _STEPS) / 1000, 3)


def wheels_of(payload: bytes) -> Wheels:
    """The wheel speeds of a drive command, mixed as the serial bridge does."""
    wanted = json.loads(payload)
    return round(wanted["z"] + wanted["x"], _DIGITS), round(wanted["z"] - wanted["x"], _DIGITS)


# -- one segment of driving, and what arrived


@dataclass(frozen=True, slots=True)
class DriveSegment:
    """``sent`` maps each pair of wheel speeds to the time of its command; all times are CLOCK_MONOTONIC, ns."""

    began: int
    ended: int
    sent: Mapping[Wheels, int]
    cpu_s: float = 0.0  # of all the robot's processes
    parts_cpu_s: Mapping[str, float] = field(default_factory=dict)  # of some of them


@dataclass(slots=True)
class Arrived:
    """Latencies of one segment, ms, and how many commands and reports were sent."""

    down: list[float] = field(default_factory=list)
    up: list[float] = field(default_factory=list)
    sent: int = 0
    reports: int = 0
    forwarded: int = 0  # commands and reports that arrived


def arrivals(entries: Sequence[Entry]) -> dict[Wheels, int]:
    """Maps each command to the time at which it first reached the MCU."""
    return {line.drive: line.ns for line in reversed(entries) if line.drive is not None}


def matched(entries: Sequence[Entry], received: Sequence[tuple[int, Touch]]) -> list[tuple[int, int | None]]:
    """Pairs the time each report was sent with the time it was received; None if it was not.

    A report is identified by its values: while the wheels turn, the sensors never report the same values for long.
    Values that were sent more than once do not count.
    """
    lines = [(entry.ns, entry.line.encode()) for entry in entries if entry.event == "said"]
    published = [(ns, touch) for ns, line in lines for touch in parse(line) if isinstance(touch, Touch)]
    times = Counter(touch for _, touch in published)
    wanted = {touch: ns for ns, touch in published if times[touch] == 1}
    first = {touch: ns for ns, touch in reversed(received) if touch in wanted and ns >= wanted[touch]}
    return [(ns, first.get(touch)) for touch, ns in wanted.items()]


def all_arrived(segment: DriveSegment, commands: Mapping[Wheels, int], reports: Reports) -> bool:
    """Whether the last command and report arrived. What is still missing then was overtaken or lost: order is kept."""
    own = [received for published, received in reports if segment.began <= published <= segment.ended]
    return list(segment.sent)[-1] in commands and (not own or own[-1] is not None)


def arrived_of(
    segment: DriveSegment,
    commands: Mapping[Wheels, int],
    reports: Reports,
    received: Sequence[tuple[int, Touch]] = (),
) -> Arrived:
    """Selects the commands and reports that belong to the segment; ``received`` has reports of equal values, too."""
    arrived = sorted((commands[wheels], sent) for wheels, sent in segment.sent.items() if wheels in commands)
    own = [(published, received) for published, received in reports if segment.began <= published <= segment.ended]
    return Arrived(
        down=[(ns - sent) / 1e6 for ns, sent in arrived],
        up=[(received - published) / 1e6 for published, received in own if received is not None],
        sent=len(segment.sent),
        reports=len(own),
        forwarded=len(arrived) + sum(segment.began <= ns <= segment.ended for ns, _ in received),
    )


# -- what is driven


class Driven(Processes, ABC):
    """What is driven, and its operator: starts both in ``with``; both are ready when :meth:`wait` returns."""

    operator: Operator

    @abstractmethod
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

    @abstractmethod
    def _arrivals(self, since: int) -> Arrivals:
        """What arrived after ``since``."""


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
        self.subject = make(self, self.kind, ("127.0.0.1", broker.port), services=services, reports=self._reports)
        broker.wait()
        self.subject.prepare()
        self.subject.launch()
        self.operator = Operator(broker.port, BASE)
        self.closing.callback(self.operator.close)

    def wait(self) -> None:
        with closing(RobotSubscriber(self.subject.remote_port, BASE)) as subscriber:
            self.subject.expect(
                lambda: subscriber.ready_ns is not None and subscriber.first_heartbeat_ns is not None,
                f"{self.kind}: the robot is not ready", _UP_S,
            )  # fmt: skip
        running = self.subject.processes()
        if missing := [name for name in _SERVICES.values() if name not in running]:
            raise self.problem(f"{' and '.join(missing)} is not running")
        self._parts = {part: running[name] for part, name in _SERVICES.items()}

    def drive(
        self, seconds: float, rate_hz: float = RATE_HZ, *, work_us: float = 0.0, slowed: bool = False
    ) -> DriveSegment:
        """See :meth:`Operator.drive`. Raises PebbleError if one of the two bridges has ended."""
        pids = self.subject.pids()
        used, before = cpu_s(pids), self._parts_cpu_s()
        segment = super().drive(seconds, rate_hz, work_us=work_us, slowed=slowed)
        parts = {part: after - before[part] for part, after in self._parts_cpu_s().items()}
        if ended := [part for part, used_s in parts.items() if used_s <= 0]:
            raise self.problem(f"the {' and the '.join(ended)} ended while it was driven")
        return replace(segment, cpu_s=cpu_s(pids) - used, parts_cpu_s=parts)

    def _parts_cpu_s(self) -> dict[str, float]:
        return {part: cpu_s([pid]) for part, pid in self._parts.items()}

    def _arrivals(self, since: int) -> Arrivals:
        entries, received = self.subject.lines(since), self.operator.received(since)
        return arrivals(entries), matched(entries, received), received

    def problem(self, what: str) -> PebbleError:
        """An error with the robot's log."""
        return PebbleError(f"{self.kind}: {what}\n{self.subject.log()}")

    @contextmanager
    def media_load(self) -> Iterator[Callable[[], dict[str, int]]]:
        """Puts its camera and microphone in use: a program on the robot reads frames, an operator gets both.

        All media flow as the ``with`` block begins, and stop with it. It is given what counts the received frames and
        packets so far, by flow. Raises PebbleError naming what does not flow.
        """
        robot, before = self.subject, len(self.subject.pids())
        workers = [
            self.worker("frame reader", _MODULE, "frames", robot.run_dir),
            self.worker("media operator", _MODULE, "media", robot.remote_port, robot.base),
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
        self._subscriber = self.worker("the subscriber", _MODULE, "hop", broker.port, DRIVE.topic(_HOP_BASE))
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


# -- programs beside the robot


def frames(run_dir: str) -> None:
    from pebble.transports.frames import FrameReader  # only here: it needs numpy

    counts: Counter[str] = Counter()
    ended = serve_on_thread(lambda _line: dict(counts))
    with FrameReader(Path(run_dir), "camera", views=True) as reader:
        while not ended.is_set():
            frame = reader.read(_READ_S)
            if frame is not None:
                counts["frames"] += bool(frame.data[::_EVERY].any())
                frame.release()


def media(port: str, base: str) -> None:
    names = {CAMERA.topic(base): "video", AUDIO.topic(base): "audio"}
    counts: Counter[str] = Counter()

    def count(message: MQTTMessage) -> None:
        counts[names[message.topic]] += 1

    client = StockClient(count, [(topic, 0) for topic in names], at_once=False).open(int(port))
    serve(lambda _line: dict(counts))
    client.close()


def hop(port: str, topic: str) -> None:
    received: list[tuple[int, bytes]] = []

    def receive(message: MQTTMessage) -> None:
        if not message.payload.isspace():  # else a bridge's probe
            received.append((time.monotonic_ns(), bytes(message.payload)))

    def take(_line: str) -> dict[str, Any]:
        new = received.copy()
        del received[: len(new)]
        return {"received": [[*wheels_of(payload), ns] for ns, payload in new]}

    client = StockClient(receive, [(topic, DRIVE.default_qos)], at_once=False).open(int(port))
    client.wait()
    answer({"subscribed": True})
    serve(take)
    client.close()


_PROGRAMS: Mapping[str, Callable[..., None]] = {"frames": frames, "media": media, "hop": hop}

if __name__ == "__main__":
    _PROGRAMS[sys.argv[1]](*sys.argv[2:])
