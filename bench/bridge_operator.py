"""An operator who drives at a steady rate over MQTT, what is driven, and which commands and reports of its MCU arrived.

As processes beside the robot: ``python -m pebble.bench.bridge_operator WHAT …``. ``frames RUN_DIR`` reads a robot's
frames and ``media PORT BASE`` receives its video and sound; both answer every line with the counts so far. ``hop PORT
BASE TRACE`` is a stock client one hop from the operator, which writes a trace as a simulated MCU does.
"""

from __future__ import annotations

import json
import signal
import socket
import sys
import threading
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from paho.mqtt.client import MQTTMessage

from pebble import contract
from pebble.bench.drivers import RATE_HZ, StockClient
from pebble.bench.null import spin
from pebble.bench.subscribers import RobotSubscriber
from pebble.bench.usage import cpu_s
from pebble.contract import DRIVE, ONLINE, STATUS, TOUCH_SENSORS
from pebble.errors import PebbleError
from pebble.rig.processes import Processes, python
from pebble.rig.robot import BASE, Robot, synthetic_media
from pebble.rig.worker_end import serve, serve_on_thread
from pebble.services.serial_mcu_bridge.text.goob_base import Touch, parse
from pebble.simulation.trace import Entry, Trace

STAND_IN, HOP = "paho", "one hop"  # paho: two plain programs in place of a robot of ours, see stand_in
ALL, FORWARDER, SERIAL = "all", "bridge", "serial bridge"  # processes of a robot
FLOWS = ("frames", "video", "audio")
_SERVICES = {FORWARDER: "mqtt_bridge", SERIAL: "serial_mcu_bridge"}
_MODULE = "pebble.bench.bridge_operator"
_MEDIA: Final = synthetic_media((1920, 1080, 30), (640, 360, 15))
_DIGITS = 3  # of a wheel's speed on the serial line
_STEPS = 800  # wheel values 0.100 … 0.899
_READ_S = 0.2
_EVERY = 16  # bytes: one in so many of a picture's is read
_UP_S, _STARTUP_S, _ANSWER_S = 30.0, 1.0, 5.0
_ARRIVE_S = 1.0  # commands and reports that take longer count as lost
_POLL_S = 0.05

Wheels = tuple[float, float]
Reports = Sequence[tuple[int, int | None]]  # when each was sent, and when it was received; None: it was not
Received = Sequence[tuple[int, Touch]]  # all reports that were received, with their times


@dataclass(slots=True, kw_only=True)
class Turn:
    """One turn of driving. ``sent`` maps each pair of wheel speeds to the time of its command: CLOCK_MONOTONIC, ns."""

    began: int = 0
    ended: int = 0
    sent: dict[Wheels, int] = field(default_factory=dict)
    cpu_s: Mapping[str, float] = field(default_factory=dict)  # of the robot's processes: of all, and of its bridges
    down: Sequence[float] = ()  # latencies of commands, ms
    up: Sequence[float] = ()  # and of reports
    reports: int = 0  # that were sent
    forwarded: int = 0  # commands and reports that arrived

    def match(self, commands: Mapping[Wheels, int], reports: Reports, received: Received = ()) -> bool:
        """Takes what belongs to the turn; ``received`` has reports of equal values, too.

        Returns whether the last command and report arrived. What is missing then was overtaken or lost: order is kept.
        """
        arrived = sorted((commands[wheels], sent) for wheels, sent in self.sent.items() if wheels in commands)
        own = [one for one in reports if self.began <= one[0] <= self.ended]
        self.down = [(ns - sent) / 1e6 for ns, sent in arrived]
        self.up = [(ns - sent) / 1e6 for sent, ns in own if ns is not None]
        self.reports = len(own)
        self.forwarded = len(arrived) + sum(self.began <= ns <= self.ended for ns, _ in received)
        return all(last in commands for last in [*self.sent][-1:]) and (not own or own[-1][1] is not None)


def wheels(number: int) -> Wheels:
    """The wheel speeds of command ``number`` (0 … 639,999): each pair is unique."""
    return round(0.1 + (number % _STEPS) / 1000, 3), round(0.1 + (number // _STEPS % _STEPS) / 1000, 3)


def wheels_of(payload: bytes | bytearray) -> Wheels:
    """The wheel speeds of a drive command, mixed as the serial bridge does."""
    wanted = json.loads(payload)
    return round(wanted["z"] + wanted["x"], _DIGITS), round(wanted["z"] - wanted["x"], _DIGITS)


# -- what arrived


def arrivals(entries: Sequence[Entry]) -> dict[Wheels, int]:
    """Maps each command to the time at which it first reached the MCU."""
    return {line.drive: line.ns for line in reversed(entries) if line.drive is not None}


def matched(entries: Sequence[Entry], received: Received) -> list[tuple[int, int | None]]:
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


# -- what is driven


class DrivenRobot(Processes):
    """A robot and its operator: starts both in ``with``. With ``reports`` it forwards those of its MCU.

    The operator has one MQTT connection to the remote broker, with the TCP options of our own clients. TCP_NODELAY: see
    :class:`StockClient`. TCP_QUICKACK: otherwise a stock broker delays a report by up to 40 ms while its answer to a
    command is not acknowledged. Without them the comparison would measure that.
    """

    def __init__(self, kind: str, *, media: bool = False, reports: bool = True) -> None:
        super().__init__()
        self.kind, self._media, self._reports = kind, media, reports
        self._number = 0  # of the last command
        self._received: list[tuple[int, bytes]] = []  # reports
        self._parts: dict[str, list[int]] = {}  # the processes that forward

    def start(self) -> None:
        """Raises PebbleError if something does not start."""
        make, services = {STAND_IN: StandIn, HOP: OneHop}.get(self.kind, Robot), _MEDIA if self._media else {}
        broker = self.broker("remote")
        self.subject = make(self, self.kind, ("127.0.0.1", broker.port), services=services, reports=self._reports)
        broker.wait()
        self.subject.prepare()
        self.subject.launch()
        channels = (STATUS, ONLINE, TOUCH_SENSORS)
        self._client = StockClient(self._on_message, [(channel.topic(BASE), 1) for channel in channels])
        self._client.paho.on_publish = self._acknowledge
        self.closing.enter_context(closing(self._client.open(broker.port)))

    def wait(self) -> None:
        """Until it is ready. Raises PebbleError if it does not become so."""
        with closing(RobotSubscriber(self.subject.remote_port, BASE)) as subscriber:
            self.subject.expect(
                lambda: subscriber.ready_ns is not None and subscriber.first_heartbeat_ns is not None,
                f"{self.kind}: the robot is not ready", _UP_S,
            )  # fmt: skip
        running = self.subject.processes()
        self._parts = {part: [running[name]] for part, name in _SERVICES.items() if name in running}
        if running and len(self._parts) < len(_SERVICES):
            raise PebbleError(f"{self.kind}: a bridge is not running\n{self.subject.log()}")

    def drive(self, seconds: float, rate_hz: float = RATE_HZ, *, work_us: float = 0.0, slowed: bool = False) -> Turn:
        """The operator works for ``work_us`` before each command: before it reads the clock, or, if ``slowed``, after.

        Raises PebbleError if one of the two bridges has ended.
        """
        groups = {ALL: self.subject.pids(), **self._parts}
        before = {name: cpu_s(pids) for name, pids in groups.items()}
        turn, due = Turn(began=time.monotonic_ns()), time.monotonic()
        for _ in range(round(seconds * rate_hz)):
            self._number += 1
            left, right = wheels(self._number)
            spin(0.0 if slowed else work_us)
            turn.sent[left, right] = time.monotonic_ns()
            spin(work_us if slowed else 0.0)
            self._client.send(DRIVE, BASE, {"x": (left - right) / 2, "z": (left + right) / 2})
            due += 1 / rate_hz
            time.sleep(max(0.0, due - time.monotonic()))
        turn.ended = time.monotonic_ns()
        turn.cpu_s = {name: cpu_s(pids) - before[name] for name, pids in groups.items() if pids}
        if min(turn.cpu_s.values(), default=1.0) <= 0:
            raise PebbleError(f"{self.kind}: a process ended while it was driven\n{self.subject.log()}")
        return turn

    def match_arrivals(self, turns: Sequence[Turn]) -> None:
        """Waits for the last commands and reports, or until they count as lost, and adds to each turn what arrived."""
        since, end = min(turn.began for turn in turns), time.monotonic() + _ARRIVE_S
        late = False
        while not late:
            late = time.monotonic() > end
            entries = self.subject.lines(since)
            received = [(ns, Touch(**json.loads(raw)["value"])) for ns, raw in self._received.copy() if ns >= since]
            commands, reports = arrivals(entries), matched(entries, received)
            if [turn.match(commands, reports, received) for turn in turns][-1]:
                return
            time.sleep(_POLL_S)

    def drive_with_media(self, seconds: float) -> tuple[Turn, dict[str, int]]:
        """The same with its camera and microphone in use: a program on the robot reads frames, an operator gets both.

        Returns what arrived, and how many frames and packets were received meanwhile. Raises PebbleError without any.
        """
        robot, before = self.subject, len(self.subject.pids())
        workers = [
            self.worker("frame reader", _MODULE, "frames", robot.run_dir),
            self.worker("media operator", _MODULE, "media", robot.remote_port, BASE),
        ]

        def counts() -> dict[str, int]:
            for worker in workers:
                worker.send("")
            return {name: count for worker in workers for name, count in worker.answer(_ANSWER_S).items()}

        self._allow_media(True)
        robot.expect(lambda: all(counts().values()), "its media do not flow", _UP_S)
        time.sleep(_STARTUP_S)
        first = counts()
        turn = self.drive(seconds)
        flowed = {name: count - first[name] for name, count in counts().items()}
        self._allow_media(False)
        for worker in workers:
            self.end(worker)
        robot.expect(lambda: len(robot.pids()) <= before, "its media do not end", _UP_S)
        self.match_arrivals([turn])
        return turn, flowed

    def _allow_media(self, wanted: bool) -> None:
        """Allows and requests video and audio, or stops both."""
        for flag in (contract.MQTT_VIDEO, contract.MQTT_AUDIO):
            self._client.send(flag, BASE, wanted)
        for request in (contract.VIDEO_CONTROL, contract.AUDIO_CONTROL):
            self._client.send(request, BASE, {"enabled": wanted})

    def _on_message(self, message: MQTTMessage) -> None:
        if message.topic.endswith(TOUCH_SENSORS.suffix):
            self._received.append((time.monotonic_ns(), bytes(message.payload)))
        self._acknowledge()

    def _acknowledge(self, *_: object) -> None:
        """Sets TCP_QUICKACK. The kernel resets it whenever we send, so this is called after every message."""
        sock: Any = self._client.paho.socket()
        if sock is not None:
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)


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


class OneHop(Robot):
    """The lower bound: a stock client, one hop through a stock broker without other traffic. Its CPU does not count."""

    def prepare(self, _ending: threading.Event | None = None) -> None:
        self._trace.touch()

    def launch(self) -> None:
        self.start("the subscriber", python(_MODULE, "hop", self.remote_port, self.base, self._trace))

    def processes(self) -> dict[str, int]:
        return {}

    def pids(self) -> list[int]:
        return []


# -- programs beside the robot


def frames(run_dir: str) -> None:
    from pebble.transports.frames import FrameReader  # only here: it needs numpy

    counts = {"frames": 0}
    ended = serve_on_thread(lambda _line: counts)
    with FrameReader(Path(run_dir), "camera", views=True) as reader:
        while not ended.is_set():
            frame = reader.read(_READ_S)
            if frame is not None:
                counts["frames"] += bool(frame.data[::_EVERY].any())
                frame.release()


def media(port: str, base: str) -> None:
    names = {contract.CAMERA.topic(base): "video", contract.AUDIO.topic(base): "audio"}
    counts = dict.fromkeys(names.values(), 0)

    def count(message: MQTTMessage) -> None:
        counts[names[message.topic]] += 1

    with closing(StockClient(count, [(topic, 0) for topic in names], at_once=False).open(int(port))):
        serve(lambda _line: counts)


def hop(port: str, base: str, path: str) -> None:
    trace = Trace(Path(path))

    def receive(message: MQTTMessage) -> None:
        ns = time.monotonic_ns()
        trace.add(Entry(ns, "line", "M {:.3f} {:.3f}".format(*wheels_of(message.payload))))

    client = StockClient(receive, [(DRIVE.topic(base), DRIVE.default_qos)], at_once=False).open(int(port))
    client.wait()
    client.send(STATUS, base, {"value": {"services": {HOP: {"state": "ready"}}}})
    client.send(ONLINE, base, {})
    signal.pause()


if __name__ == "__main__":
    globals()[sys.argv[1]](*sys.argv[2:])
