"""Measures a robot's start-up, how fast a late subscriber receives all retained messages, and the first picture.

On MQTT and on Zenoh. Every launch is a fresh robot: launcher, hub or local broker, bridges, a simulated MCU, a remote
broker; for the first pictures another one, with a camera.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from rich.console import Console
from rich.table import Table

from pebble.bench import first_picture, late_subscriber
from pebble.bench.output import FOLDER, check_folder, finish
from pebble.bench.results import Cell, Stopwatch
from pebble.bench.robot_comparison import against, caveat, sentence, spread
from pebble.bench.robot_subscriber import RobotSubscriber
from pebble.bench.rounds import Rounds
from pebble.bench.tables import plain_table
from pebble.rig.robot import BASE, KINDS, Robot, check_kinds, one_robot
from pebble.runtime.signals import interrupted_by_signals
from pebble.transports.segments import sweep

ROUNDS, QUICK_ROUNDS = 10, 3
PICTURES_EVERY = 5  # launches, the first of which is followed by one of a robot with a camera
JOINS, QUICK_JOINS = 5, 3  # late subscribers of each sort to each robot
RATE_HZ = 20.0  # of the operator, who drives from the start
_UP_S = 20.0
_SLICE_S = 0.2  # of driving between two checks whether to stop
_ANSWER_S = 60.0


@dataclass(frozen=True, slots=True, kw_only=True)
class StartupPlan:
    """The options of a run: launches of each kind, in turn."""

    rounds: int | None = None  # None: the default
    kinds: Sequence[str] = KINDS
    quick: bool = False
    output: Path = FOLDER

    @property
    def launches(self) -> int:
        return self.rounds or (QUICK_ROUNDS if self.quick else ROUNDS)

    @property
    def joins(self) -> int:
        return QUICK_JOINS if self.quick else JOINS

    def check(self) -> None:
        """Raises PebbleError naming an invalid option."""
        check_kinds(self.kinds)
        check_folder(self.output)

    def command(self) -> list[str]:
        """The command line that repeats the run."""
        kinds = [] if tuple(self.kinds) == KINDS else ["--variants", ",".join(self.kinds)]
        quick = ["--quick"] if self.quick else []
        return ["pebble", "bench", "startup", "--rounds", str(self.launches), *kinds, *quick]


@dataclass(slots=True, kw_only=True)
class Launch:
    """One robot's start. Seconds count from just before its launcher is started."""

    heartbeat_s: float
    ready_s: float
    obeyed_s: float
    stock_operator_ms: list[float] = field(default_factory=list)
    operator_ms: list[float] = field(default_factory=list)
    service_ms: list[float] = field(default_factory=list)
    retained: int = 0  # topics with a retained message, at the remote broker
    retained_inside: int = 0  # on the local transport
    picture_ms: dict[tuple[str, str], float] = field(default_factory=dict)  # by encoding and state of the camera


@dataclass(frozen=True, slots=True)
class Measure:
    """One measure of every launch."""

    name: str
    unit: str
    samples: Callable[[Launch], list[float]]
    retained: Callable[[Launch], int] | None = None


def _picture(encoding: str, state: str) -> Measure:
    def samples(launch: Launch) -> list[float]:
        return [ms for (name, camera), ms in launch.picture_ms.items() if (name, camera) == (encoding, state)]

    return Measure(f"picture, {encoding}, {state}", "ms", samples)


PICTURES = tuple(_picture(encoding, state) for state in first_picture.STATES for encoding in first_picture.ENCODINGS)
MEASURES = (
    Measure("first heartbeat", "s", lambda launch: [launch.heartbeat_s]),
    Measure("all ready", "s", lambda launch: [launch.ready_s]),
    Measure("first drive obeyed", "s", lambda launch: [launch.obeyed_s]),
    Measure("late operator", "ms", lambda launch: launch.operator_ms, lambda launch: launch.retained),
    Measure("late operator, paho", "ms", lambda launch: launch.stock_operator_ms, lambda launch: launch.retained),
    Measure("late service", "ms", lambda launch: launch.service_ms, lambda launch: launch.retained_inside),
    *PICTURES,
)
_PAPER = (
    "The paper (5.1.1) names start-up delay first among what its MQTT video should improve, and gives no figure for "
    "it; its pictures are our json."
)


def run(plan: StartupPlan, console: Console | None = None) -> int:
    """Measures, prints and writes; returns 0 if everything has results of enough rounds. Raises PebbleError."""
    console = console or Console()
    plan.check()
    watch = Stopwatch("startup", plan.command(), {"rounds": plan.launches, "joins": plan.joins, "rate_hz": RATE_HZ})
    rounds, done = Rounds(plan.launches, console), []
    with interrupted_by_signals(), console.status("") as status:
        try:
            for number in range(plan.launches):
                with rounds.attempt(number):
                    one = {}
                    for kind in plan.kinds[:: -1 if number % 2 else 1]:
                        status.update(f"launch {number + 1} of {plan.launches}: {kind}")
                        one[kind] = launch(kind, plan.joins)
                        if number % PICTURES_EVERY == 0:
                            one[kind].picture_ms = first_picture.measure(kind)
                    done.append(one)
        finally:
            sweep()  # Zenoh leaves files behind even after a regular end
    cells = cells_of({kind: [one[kind] for one in done] for kind in plan.kinds})
    console.print(table(cells))
    finish(watch.results(cells, [*rounds.notes(), *assessment(cells)], quick=plan.quick), plan.output, console)
    return rounds.code(cells)


def cells_of(launches: dict[str, list[Launch]]) -> list[Cell]:
    """One cell for each measure and kind; a round is a launch."""
    return [
        Cell(
            variant=kind,
            measure=measure.name,
            unit=measure.unit,
            rounds=[samples for launch in done if (samples := measure.samples(launch))],
            figures={} if measure.retained is None else {"topics": max(map(measure.retained, done), default=0)},
        )
        for measure in MEASURES
        for kind, done in launches.items()
    ]


def table(cells: Sequence[Cell]) -> Table:
    """Rows are measures, columns transports."""
    kinds = list(dict.fromkeys(cell.variant for cell in cells))
    ratio = [f"{kinds[1]} / {kinds[0]}"] if len(kinds) > 1 else []
    rows = plain_table("median (minimum to maximum) of the launches", ["", "unit", *kinds, *ratio], left=2)
    for measure, group in _by_measure(cells):
        rows.add_row(measure, group[0].unit, *map(spread, group), *([against(group)] if ratio else []))
    return rows


def assessment(cells: Sequence[Cell]) -> list[str]:
    lines = [
        sentence(f"{measure[0].upper()}{measure[1:]}", group, quantity="time") for measure, group in _by_measure(cells)
    ]
    return [*lines, _PAPER, *caveat([cell for cell in cells if not cell.measure.startswith("picture,")])]


def _by_measure(cells: Sequence[Cell]) -> Iterator[tuple[str, list[Cell]]]:
    for measure in dict.fromkeys(cell.measure for cell in cells):
        yield measure, [cell for cell in cells if cell.measure == measure]


# -- one launch


def launch(kind: str, joins: int) -> Launch:
    """Measures one robot from its start to its end. Raises PebbleError with its log if it does not become ready."""
    with one_robot(kind) as robot, closing(RobotSubscriber(robot.remote_port, BASE)) as subscriber:
        service = robot.running.worker("late service", "pebble.bench.late_subscriber", robot.config)
        service.answer(_ANSWER_S)  # it is started beforehand, so that its imports do not disturb the launch
        subscriber.wait()
        started = _start(robot, subscriber)
        service.send(str(joins))  # it first counts the retained messages, which gives start-up work time to finish
        answer = service.answer(_ANSWER_S)
        started.service_ms, started.retained_inside = answer["ms"], len(answer["retained"])
        port, retained = robot.remote_port, set(subscriber.retained)
        started.retained = len(retained)
        started.operator_ms = [late_subscriber.operator_ms(port, BASE, retained) for _ in range(joins)]
        started.stock_operator_ms = [late_subscriber.stock_operator_ms(port, BASE, retained) for _ in range(joins)]
        return started


def _start(robot: Robot, subscriber: RobotSubscriber) -> Launch:
    with _driving(subscriber):
        began_ns = time.monotonic_ns()
        robot.launch()
        robot.expect(lambda: subscriber.first_heartbeat_ns is not None, "no heartbeat", _UP_S)
        robot.expect(lambda: subscriber.ready_ns is not None, "not every service is ready", _UP_S)
        robot.expect(lambda: bool(_obeyed(robot, began_ns)), "no drive command was obeyed", _UP_S)
    obeyed_ns = _obeyed(robot, began_ns)[0]
    times = (subscriber.first_heartbeat_ns or 0, subscriber.ready_ns or 0, obeyed_ns)
    heartbeat_s, ready_s, obeyed_s = ((time_ns - began_ns) / 1e9 for time_ns in times)
    return Launch(heartbeat_s=heartbeat_s, ready_s=ready_s, obeyed_s=obeyed_s)


def _obeyed(robot: Robot, since_ns: int) -> list[int]:
    """The times at which lines that move the wheels reached the MCU."""
    return [line.ns for line in robot.lines(since_ns) if line.drive is not None and any(line.drive)]


@contextmanager
def _driving(operator: RobotSubscriber) -> Iterator[None]:
    """Sends commands at a steady rate during the ``with`` block, whether or not the robot receives them."""
    enough = threading.Event()

    def drive() -> None:
        while not enough.is_set():
            operator.drive(_SLICE_S, RATE_HZ)

    thread = threading.Thread(target=drive, name="driver", daemon=True)
    thread.start()
    try:
        yield
    finally:
        enough.set()
        thread.join()
