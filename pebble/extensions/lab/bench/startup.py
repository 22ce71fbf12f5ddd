"""Measures a robot's start-up, its memory, and how fast a late subscriber receives all retained messages.

Every launch is a fresh robot at a remote broker that runs already; an operator subscribes there, and sends drive
commands at 20 Hz, before the launcher is started. ``first heartbeat``, ``all ready`` and ``first drive obeyed`` count
from just before that, the last one until a line that moves the wheels has reached the MCU's pty. ``late service``: from
the begin of a service's connection until the last retained topic has arrived. ``minimal``: a robot without motors,
whose memory (PSS) and threads are measured, too; ``floor``: one process with the same connections (floor.py).
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator, Mapping, Set
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rich.console import Console
from rich.table import Table

from pebble.config import load
from pebble.contract import ONLINE, STATUS
from pebble.errors import PebbleError
from pebble.extensions.lab.bench.clients import UP_S, RobotSubscriber, driving
from pebble.extensions.lab.bench.results import Cell, Results, begin, round_cell
from pebble.extensions.lab.bench.rounds import Progress, in_turn, measure_rounds
from pebble.extensions.lab.bench.show import RATIOS, Shown, compared, plain_table, spread
from pebble.extensions.lab.bench.usage import pss_mb, threads
from pebble.extensions.lab.rig.robot import BASE, KINDS, Config, Robot, one_robot
from pebble.runtime.connections import local_transport
from pebble.transports import Message, Transport

STARTED: Final = ("first heartbeat", "all ready", "first drive obeyed")
LATE: Final = "late service"
MEMORY, THREADS = "PSS", "threads"
_SETTLED_S = 0.5  # from the first heartbeat until memory is read
_LATE_S = 10.0  # for one late subscriber
_QUIET_S = 0.3  # without another retained message until all count as received
_EVERYTHING = f"{BASE}/#"


class Floor(Robot):
    """A process that takes the place of the launcher and its services."""

    def launch(self) -> None:
        program = [sys.executable, "-P", str(Path(__file__).with_name("floor.py"))]
        place = self.folder / "floor.sock" if self.local_port is None else self.local_port
        topics = (ONLINE.topic(self.base), STATUS.topic(self.base))
        self.start(f"the {self.kind} floor", [*program, str(place), str(self.remote_port), *topics])

    def processes(self) -> dict[str, int]:
        return {program.name: program.pid for program in (self.launcher, self.local_broker) if program is not None}


#: Of each kind a whole robot, a robot without motors and a floor are launched: the class of each, and its services.
PARTS: Final[Mapping[str, tuple[type[Robot], Mapping[str, Config]]]] = {
    "": (Robot, {}),
    "minimal": (Robot, {"serial_mcu_bridge": {"enabled": False}}),
    "floor": (Floor, {}),
}
VARIANTS: Final = [f"{kind} {part}".rstrip() for part in PARTS for kind in KINDS]


@dataclass(frozen=True, slots=True)
class Settings:
    """The number of launches per variant, one in each round, and of late subscribers per launch."""

    rounds: int = 10
    joins: int = 5


FULL: Final = Settings()
QUICK: Final = Settings(rounds=3, joins=3)


def run(settings: Settings, console: Console) -> Shown:
    """Measure all variants. Raises PebbleError."""
    results = begin("startup", settings)

    def measure_round(number: int, progress: Progress) -> Iterator[Cell]:
        for variant in in_turn(VARIANTS, number):
            progress(variant)
            yield from launch(variant, settings.joins)

    measure_rounds(results, settings.rounds, measure_round, console)
    return Shown(results, [table(results), floor_table(results)])


def table(results: Results) -> Table:
    """Return the times of both variants, and their ratio."""
    grid = plain_table("Median (minimum to maximum) of the launches", ["", "unit", "mqtt", "zenoh", "zenoh / mqtt"],
                        left=2, caption=RATIOS)  # fmt: skip
    for measure, unit in (*((name, "s") for name in STARTED), (LATE, "ms")):
        mqtt, zenoh = results.find("mqtt", measure), results.find("zenoh", measure)
        grid.add_row(measure, unit, spread(mqtt), spread(zenoh), compared(zenoh, mqtt))
    return grid


def floor_table(results: Results) -> Table:
    """Return the start and the memory of minimal robots, as multiples of the floor."""
    heads = [f"{kind} {name}" for kind in KINDS for name in ("minimal", "floor", "ratio")]
    grid = plain_table("Minimal robots, and one process", ["", "unit", *heads], left=2, caption=RATIOS)
    for measure, unit in ((STARTED[0], "s"), (MEMORY, "MB"), (THREADS, "")):
        row = list[str]()
        for kind in KINDS:
            minimal, floor = results.find(f"{kind} minimal", measure), results.find(f"{kind} floor", measure)
            row += [spread(minimal), spread(floor), compared(minimal, floor)]
        grid.add_row(measure, unit, *row)
    return grid


def launch(variant: str, joins: int) -> Iterator[Cell]:
    """Launch a fresh robot; yield its times in seconds from just before that. Raises PebbleError with its log."""
    kind, _, part = variant.partition(" ")
    make, services = PARTS[part]
    with (
        one_robot(kind, make, services=services) as robot,
        closing(RobotSubscriber(robot.remote_port, BASE)) as subscriber,
    ):
        subscriber.wait()
        with driving(robot.remote_port, BASE):
            began_ns = time.monotonic_ns()
            robot.launch()
            robot.expect(lambda: subscriber.first_heartbeat_ns is not None, "no heartbeat", UP_S)
            robot.expect(lambda: subscriber.ready_ns is not None, "not every service is ready", UP_S)
            times_ns = [subscriber.first_heartbeat_ns or 0, subscriber.ready_ns or 0]
            if not part:  # a whole robot; minimal ones and floors have no motors
                robot.expect(lambda: bool(_obeyed(robot, began_ns)), "no drive command was obeyed", UP_S)
                times_ns.append(_obeyed(robot, began_ns)[0])
        for name, at_ns in zip(STARTED, times_ns, strict=False):
            yield round_cell(variant, name, "s", [(at_ns - began_ns) / 1e9])
        time.sleep(_SETTLED_S)
        pids = robot.processes().values()
        yield round_cell(variant, MEMORY, "MB", [sum(map(pss_mb, pids))])
        yield round_cell(variant, THREADS, "", [sum(map(threads, pids))])
        if not part:
            topics = _retained_topics(_service(robot))  # start-up work finishes meanwhile
            yield round_cell(kind, LATE, "ms", [_late_ms(topics, _service(robot)) for _ in range(joins)])


def _obeyed(robot: Robot, since_ns: int) -> list[int]:
    """Return the times at which lines that move the wheels reached the MCU."""
    return [line.ns for line in robot.lines(since_ns) if line.drive is not None and any(line.drive)]


# -- late services wait for all retained messages of a running robot


def _service(robot: Robot) -> Transport:
    return local_transport(load(robot.config), "late-service")


def _retained_topics(transport: Transport) -> set[str]:
    """Return the topics with a retained message. It waits for a pause, since no message is marked as the last."""
    messages: list[Message] = []
    with transport:
        transport.subscribe(_EVERYTHING, messages.append, direct=True)
        topics, earlier = set[str](), None
        while topics != earlier:
            time.sleep(_QUIET_S)
            earlier, topics = topics, {message.topic for message in messages if message.retain}
    return topics


def _late_ms(topics: Set[str], transport: Transport) -> float:
    """Return the ms from opening a connection until messages on all topics have arrived. Raises PebbleError."""
    missing, complete, ended_ns = set(topics), threading.Event(), 0

    def receive(message: Message) -> None:
        nonlocal ended_ns
        missing.discard(message.topic)
        if not missing and not complete.is_set():
            ended_ns = time.monotonic_ns()
            complete.set()

    with closing(transport):
        began_ns = time.monotonic_ns()
        transport.open(timeout=0.0)
        transport.subscribe(_EVERYTHING, receive, direct=True)
        complete.wait(_LATE_S)
    if missing:
        raise PebbleError(f"a late subscriber did not receive {', '.join(missing)} within {_LATE_S:.0f} s")
    return (ended_ns - began_ns) / 1e6
