"""An operator who drives at a steady rate over MQTT, what is driven, and which commands and reports of its MCU arrived.

As processes beside the robot: ``python -m pebble.extensions.lab.bench.bridge_operator WHAT …``. ``frames RUN_DIR``
reads a robot's frames and ``media PORT BASE`` receives its video and sound; both answer every line with the counts so
far. ``hop PORT BASE TRACE`` is a stock client one hop from the operator, which writes a trace as a simulated MCU does.
"""

from __future__ import annotations

import json
import signal
import socket
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Final, NamedTuple

from paho.mqtt.client import MQTTMessage

from pebble import contract
from pebble.errors import PebbleError
from pebble.extensions.lab.bench.clients import RobotSubscriber, StockClient, drive_of
from pebble.extensions.lab.bench.results import STAND_IN
from pebble.extensions.lab.bench.usage import cpu_s
from pebble.extensions.lab.rig.processes import python
from pebble.extensions.lab.rig.robot import BASE, Robot, one_robot, synthetic_media
from pebble.extensions.lab.rig.worker_end import serve, serve_on_thread
from pebble.extensions.lab.simulation.trace import Entry, Trace
from pebble.extensions.operator.client.scripted_operator import paced
from pebble.services.serial_mcu_bridge.text.goob_base import Touch, parse

HOP = "one hop"
ALL = "all"  # processes of a robot; and those that forward, by the names of their services
SERVICES = {"bridge": "mqtt_bridge", "serial bridge": "serial_mcu_bridge"}
_MODULE = "pebble.extensions.lab.bench.bridge_operator"
_MEDIA: Final = synthetic_media((1920, 1080, 30), (640, 360, 15))
_DIGITS = 3  # of a wheel's speed on the serial line
_STEPS = 800  # wheel values 0.100 … 0.899
_READ_S = 0.2
_EVERY = 16  # bytes: one in so many of a picture's is read
_UP_S, _STARTUP_S, _ANSWER_S = 30.0, 1.0, 5.0
_ARRIVE_S = 1.0  # commands and reports that take longer count as lost

Wheels = tuple[float, float]


class Turn(NamedTuple):
    """One turn of driving. All times are CLOCK_MONOTONIC, ns."""

    began: int
    ended: int
    sent: Mapping[Wheels, int]  # when each command was, by its wheel speeds
    cpu_s: Mapping[str, float]  # of the robot's processes: of all, and of its bridges


class Arrived(NamedTuple):
    """What arrived in several turns."""

    commands: Mapping[Wheels, int]  # when each reached the MCU
    reports: Sequence[tuple[int, int | None]]  # of the MCU: when each was sent, and received; None: it was not
    received: Sequence[tuple[int, Touch]]  # all reports, also those of equal values


def wheels(number: int) -> Wheels:
    """The wheel speeds of command ``number`` (0 … 639,999): each pair is unique."""
    return round(0.1 + (number % _STEPS) / 1000, 3), round(0.1 + (number // _STEPS % _STEPS) / 1000, 3)


def wheels_of(payload: bytes | bytearray) -> Wheels:
    """The wheel speeds of a drive command, mixed as the serial bridge does."""
    wanted = json.loads(payload)
    return round(wanted["z"] + wanted["x"], _DIGITS), round(wanted["z"] - wanted["x"], _DIGITS)


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


class DrivenRobot(StockClient):
    """A robot, and its operator on one MQTT connection to the remote broker, with the TCP options of our own clients.

    TCP_NODELAY: see :class:`StockClient`. TCP_QUICKACK: otherwise a stock broker delays a report by up to 40 ms while
    its answer to a command is not acknowledged. Without them the comparison would measure that.
    """

    def __init__(self, robot: Robot) -> None:
        channels = (contract.STATUS, contract.ONLINE, contract.TOUCH_SENSORS)
        super().__init__(self._on_message, [(channel.topic(BASE), 1) for channel in channels])
        self.paho.on_publish = self._acknowledge
        self.robot = robot
        self._driver = self.driver(BASE)
        self._number = 0  # of the last command
        self._received: list[tuple[int, bytes]] = []  # reports
        self._parts: dict[str, list[int]] = {}  # the processes that forward
        self.open(robot.remote_port)

    def wait_until_ready(self) -> None:
        """Raises PebbleError if it does not become so."""
        robot = self.robot
        with closing(RobotSubscriber(robot.remote_port, BASE)) as seen:
            robot.expect(lambda: None not in (seen.ready_ns, seen.first_heartbeat_ns), "it is not ready", _UP_S)
        running = robot.processes()
        self._parts = {part: [running[name]] for part, name in SERVICES.items() if name in running}
        if running and len(self._parts) < len(SERVICES):
            raise PebbleError(f"{robot.kind}: a bridge is not running\n{robot.log()}")

    def drive(self, seconds: float) -> Turn:
        """Drive at a steady rate. Raises PebbleError if one of the two bridges has ended."""
        groups = {ALL: self.robot.pids(), **self._parts}
        before = {name: cpu_s(pids) for name, pids in groups.items()}
        sent: dict[Wheels, int] = {}
        began = time.monotonic_ns()
        for _ in paced(seconds):
            self._number += 1
            speeds = wheels(self._number)
            sent[speeds] = round(1e9 * self._driver.command(drive_of(*speeds)))
        ended = time.monotonic_ns()
        used = {name: cpu_s(pids) - before[name] for name, pids in groups.items() if pids}
        if min(used.values(), default=1.0) <= 0:
            raise PebbleError(f"{self.robot.kind}: a process ended while it was driven\n{self.robot.log()}")
        return Turn(began, ended, sent, used)

    def arrived(self, turns: Sequence[Turn]) -> Arrived:
        """Waits until the last commands and reports have arrived or count as lost."""
        time.sleep(max(0.0, turns[-1].ended / 1e9 + _ARRIVE_S - time.monotonic()))
        since = turns[0].began
        entries = self.robot.lines(since)
        received = [(ns, Touch(**json.loads(raw)["value"])) for ns, raw in self._received.copy() if ns >= since]
        return Arrived(arrivals(entries), matched(entries, received), received)

    def drive_with_media(self, seconds: float) -> Turn:
        """The same with its camera and microphone in use: a program on the robot reads frames, an operator gets both.

        Raises PebbleError if these do not flow before it or meanwhile.
        """
        robot, at_rest = self.robot, len(self.robot.pids())
        workers = [
            robot.running.worker("frame reader", _MODULE, "frames", robot.run_dir),
            robot.running.worker("media operator", _MODULE, "media", robot.remote_port, BASE),
        ]

        def counts() -> list[int]:
            return [count for worker in workers for count in worker.ask("", _ANSWER_S).values()]

        self.request_media(BASE)
        robot.expect(lambda: all(counts()), "its media do not flow", _UP_S)
        time.sleep(_STARTUP_S)
        before = counts()
        turn = self.drive(seconds)
        if any(now == then for now, then in zip(counts(), before, strict=True)):
            raise PebbleError(f"{self.robot.kind}: its media stopped\n{robot.log()}")
        self.request_media(BASE, False)
        for worker in workers:
            robot.running.end(worker)
        robot.expect(lambda: len(robot.pids()) <= at_rest, "its media do not end", _UP_S)
        return turn

    def _on_message(self, message: MQTTMessage) -> None:
        if message.topic.endswith(contract.TOUCH_SENSORS.suffix):
            self._received.append((time.monotonic_ns(), bytes(message.payload)))
        self._acknowledge()

    def _acknowledge(self, *_: object) -> None:
        """Sets TCP_QUICKACK. The kernel resets it whenever we send, so this is called after every message."""
        sock: Any = self.paho.socket()
        if sock is not None:
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)


class StandIn(Robot):
    """What a user would have without us."""

    def launch(self) -> None:
        rest = (*self.broker_ports[::-1], self.base, self.port, *(["--reports"] if self.reports else []))
        for part in ("bridge", "serial"):
            self.start(f"the stand-in's {part}", python("pebble.extensions.lab.bench.stand_in", part, *rest))

    def processes(self) -> dict[str, int]:
        """Its two programs, by the names of the services that they stand for."""
        return {name: one.pid for name, one in zip(SERVICES.values(), self._started, strict=False)}


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


@contextmanager
def driven_robot(kind: str, *, media: bool = False, reports: bool = True) -> Iterator[DrivenRobot]:
    """Launches a robot and connects its operator; with ``reports`` it forwards those of its MCU. Raises PebbleError."""
    make, services = {STAND_IN: StandIn, HOP: OneHop}.get(kind, Robot), _MEDIA if media else {}
    with one_robot(kind, make, services=services, reports=reports) as robot:
        robot.launch()
        with closing(DrivenRobot(robot)) as driven:
            yield driven


def frames(run_dir: str) -> None:
    from pebble.transports.frames import FrameReader  # only here: it needs numpy

    counts = {"frames": 0}
    ended = serve_on_thread(lambda _line: counts)
    with FrameReader(Path(run_dir), "camera", views=True) as reader:
        while not ended.is_set():
            if (frame := reader.read(_READ_S)) is not None:
                counts["frames"] += bool(frame.data[::_EVERY].any())
                frame.release()


def media(port: str, base: str) -> None:
    counts = {channel.topic(base): 0 for channel in (contract.CAMERA, contract.AUDIO)}

    def count(message: MQTTMessage) -> None:
        counts[message.topic] += 1

    with closing(StockClient(count, [(topic, 0) for topic in counts], at_once=False).open(int(port))):
        serve(lambda _line: counts)


def hop(port: str, base: str, path: str) -> None:
    trace = Trace(Path(path))

    def receive(message: MQTTMessage) -> None:
        ns = time.monotonic_ns()
        trace.add(Entry(ns, "line", "M {:.3f} {:.3f}".format(*wheels_of(message.payload))))

    drive = contract.DRIVE.topic(base), contract.DRIVE.default_qos
    client = StockClient(receive, [drive], at_once=False).open(int(port))
    client.wait()
    client.send(contract.STATUS, base, {"value": {"services": {HOP: {"state": "ready"}}}})
    client.send(contract.ONLINE, base, {})
    signal.pause()


if __name__ == "__main__":
    globals()[sys.argv[1]](*sys.argv[2:])
