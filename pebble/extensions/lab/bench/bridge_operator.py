"""An operator that drives at a steady rate over MQTT, and a record of the commands and MCU reports that arrived."""

from __future__ import annotations

import json
import socket
import subprocess
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from paho.mqtt.client import MQTTMessage

from pebble import contract
from pebble.errors import PebbleError
from pebble.extensions.lab.bench.clients import RobotSubscriber, StockClient, drive_of
from pebble.extensions.lab.bench.results import FLOOR, STAND_IN
from pebble.extensions.lab.bench.usage import cpu_s
from pebble.extensions.lab.rig.processes import python
from pebble.extensions.lab.rig.robot import BASE, Robot, one_robot
from pebble.extensions.lab.rig.scripted_operator import paced
from pebble.extensions.lab.simulation.trace import Entry
from pebble.services.serial_mcu_bridge.text.goob_base import Touch, parse

SERVICES = {"bridge": "mqtt_bridge", "serial bridge": "serial_mcu_bridge"}  # the processes that forward
_STEPS = 800  # wheel values 0.100 … 0.899
_UP_S = 30.0
_ARRIVE_S = 1.0  # commands and reports that take longer count as lost

Wheels = tuple[float, float]


class Turn(NamedTuple):
    """A turn of driving. All times are CLOCK_MONOTONIC, ns."""

    began: int
    ended: int
    sent: Mapping[Wheels, int]  # when each command was, by its wheel speeds
    cpu_s: Mapping[str, float]  # of the robot's two bridges


class Report(NamedTuple):
    """The times of a report of the MCU: when it was sent, and received; None: it was not. CLOCK_MONOTONIC, ns."""

    sent_ns: int
    received_ns: int | None


class Arrived(NamedTuple):
    """The messages that arrived, of several turns of driving."""

    commands: Mapping[Wheels, int]  # when each reached the MCU
    reports: Sequence[Report]  # those whose values were sent once
    received: Sequence[tuple[int, Touch]]  # when each report was received, and its values: all reports


def wheels(number: int) -> Wheels:
    """Return the wheel speeds of command ``number`` (0 … 639,999), a different pair for each number."""
    return round(0.1 + (number % _STEPS) / 1000, 3), round(0.1 + (number // _STEPS % _STEPS) / 1000, 3)


def arrivals(entries: Sequence[Entry]) -> dict[Wheels, int]:
    """Return the time at which each command first reached the MCU."""
    return {line.drive: line.ns for line in reversed(entries) if line.drive is not None}


def matched(entries: Sequence[Entry], received: Sequence[tuple[int, Touch]]) -> list[Report]:
    """Return the reports that the MCU sent, each with the time of its first arrival after that.

    A report is identified by its values: while the wheels turn, the sensors never report the same values for long.
    Values that were sent more than once do not count.
    """
    sent = [
        (entry.ns, touch)
        for entry in entries
        if entry.event == "said"
        for touch in parse(entry.line.encode())
        if isinstance(touch, Touch)
    ]
    counts = Counter(touch for _, touch in sent)
    sent_ns = {touch: ns for ns, touch in sent if counts[touch] == 1}
    received_ns: dict[Touch, int] = {}
    for ns, touch in received:
        if touch in sent_ns and ns >= sent_ns[touch]:
            received_ns.setdefault(touch, ns)
    return [Report(ns, received_ns.get(touch)) for touch, ns in sent_ns.items()]


class DrivenRobot(StockClient):
    """A robot and its operator, on one MQTT connection to the remote broker with the TCP options of our own clients.

    TCP_NODELAY: see :class:`StockClient`. TCP_QUICKACK: otherwise a stock broker delays a report by up to 40 ms, until
    its answer to a command is acknowledged. Without them the comparison would measure these delays.
    """

    def __init__(self, robot: Robot) -> None:
        channels = (contract.STATUS, contract.ONLINE, contract.TOUCH_SENSORS)
        super().__init__(self._on_message, [(channel.topic(BASE), 1) for channel in channels])
        self.paho.on_publish = self._acknowledge
        self.robot = robot
        self._driver = self.driver(BASE)
        self._number = 0  # of the last command
        self._received: list[tuple[int, bytes]] = []  # reports
        self._pids: dict[str, int] = {}  # of the processes that forward, by the keys of SERVICES
        self.open(robot.remote_port)

    def wait_until_ready(self) -> None:
        """Wait until the robot is ready. Raises PebbleError if it does not become so."""
        robot = self.robot
        with closing(RobotSubscriber(robot.remote_port, BASE)) as subscriber:
            robot.expect(
                lambda: None not in (subscriber.ready_ns, subscriber.first_heartbeat_ns), "it is not ready", _UP_S
            )
        running = robot.processes()
        self._pids = {part: running[name] for part, name in SERVICES.items() if name in running}
        if len(self._pids) < len(SERVICES):
            raise PebbleError(f"{robot.kind}: a bridge is not running\n{robot.log()}")

    def drive(self, seconds: float) -> Turn:
        """Drive at a steady rate. Raises PebbleError if one of the two bridges has ended."""
        before = {part: cpu_s([pid]) for part, pid in self._pids.items()}
        sent: dict[Wheels, int] = {}  # see Turn: no two commands have the same speeds
        began = time.monotonic_ns()
        for _ in paced(seconds):
            self._number += 1
            speeds = wheels(self._number)
            sent[speeds] = round(1e9 * self._driver.command(drive_of(*speeds)))  # the time of sending
        ended = time.monotonic_ns()
        used = {part: cpu_s([pid]) - before[part] for part, pid in self._pids.items()}
        if min(used.values()) <= 0:  # the CPU time of a process that has ended is 0
            raise PebbleError(f"{self.robot.kind}: a process ended while it was driven\n{self.robot.log()}")
        return Turn(began, ended, sent, used)

    def arrived(self, turns: Sequence[Turn]) -> Arrived:
        """Wait until the last commands and reports have arrived or count as lost; return those that arrived."""
        time.sleep(max(0.0, turns[-1].ended / 1e9 + _ARRIVE_S - time.monotonic()))
        since = turns[0].began
        entries = self.robot.lines(since)
        received = [(ns, Touch(**json.loads(raw)["value"])) for ns, raw in self._received.copy() if ns >= since]
        return Arrived(arrivals(entries), matched(entries, received), received)

    def _on_message(self, message: MQTTMessage) -> None:
        if message.topic.endswith(contract.TOUCH_SENSORS.suffix):
            self._received.append((time.monotonic_ns(), bytes(message.payload)))
        self._acknowledge()

    def _acknowledge(self, *_: object) -> None:
        """Set TCP_QUICKACK. The kernel resets it whenever we send, so this is called after every message."""
        sock: Any = self.paho.socket()
        if sock is not None:
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)


class StandIn(Robot):
    """A robot as a user would build it without Pebble."""

    def launch(self) -> None:
        reports = ["--reports"] if self.reports else []
        arguments = (self.local_port, self.remote_port, self.base, self.port, *reports)
        for part in ("bridge", "serial"):
            self.start(f"the {self.name}'s {part}", [*self.command(), part, *map(str, arguments)])

    def command(self) -> list[str]:
        return python("pebble.extensions.lab.bench.stand_in")

    def processes(self) -> dict[str, int]:
        """Return the two programs, under the names of the services that they replace, and the robot's broker."""
        pids = {service: program.pid for service, program in zip(SERVICES.values(), self._started, strict=True)}
        return pids if self.local_broker is None else pids | {"mosquitto": self.local_broker.pid}


class CFloor(StandIn):
    """A stand-in whose two programs are written in C: the lower limit for robots of two programs and a broker."""

    def command(self) -> list[str]:
        return [str(compiled(self.folder / "floor"))]


def compiled(program: Path) -> Path:
    """Compile floor.c, and return the path of the programs. Raises PebbleError if gcc or libmosquitto is missing."""
    source = Path(__file__).with_name("floor.c")
    try:
        subprocess.run(["gcc", "-O2", source, "-lmosquitto", "-o", program], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        raise PebbleError(f"{FLOOR} is left out: it needs gcc and libmosquitto-dev") from None
    return program


@contextmanager
def driven_robot(kind: str, *, reports: bool = True) -> Iterator[DrivenRobot]:
    """Yield a new robot with its operator; with ``reports`` it forwards its MCU's reports. Raises PebbleError."""
    with one_robot(kind, {STAND_IN: StandIn, FLOOR: CFloor}.get(kind, Robot), reports=reports) as robot:
        robot.launch()
        with closing(DrivenRobot(robot)) as driven:
            yield driven
