"""Measures memory, CPU and threads of each process of a robot, idle and active, on MQTT and on Zenoh.

Whole robots with a synthetic camera and microphone, stock mosquitto, a simulated MCU. The phases have a fixed order;
each starts with the memory that the one before left allocated. Shared libraries divide their memory among the processes
that map them: nothing large is imported here, since that would reduce the robot's PSS.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from pebble.bench.comparison import Budget, Case, Comparison, rounds, seconds, variants
from pebble.bench.drivers import RATE_HZ, driving
from pebble.bench.pictures import bars
from pebble.bench.results import Cell
from pebble.bench.subscribers import RobotSubscriber, ready_robot
from pebble.bench.tables import Claims, Grid, median_column
from pebble.bench.usage import cpu_s, pss_mb
from pebble.errors import PebbleError
from pebble.rig.robot import BASE, KINDS, Robot

ALL = "all"  # the processes of a robot together
MEMORY, CPU, THREADS = "PSS", "CPU", "threads"
_UNITS = {MEMORY: "MB", CPU: "%", THREADS: ""}  # CPU: per cent of one core
PICTURES, PER_PICTURE = "pictures", "CPU per picture"
IDLE, DRIVING = "idle", "driving"
#: The encodings requested in each media phase, by the name of the phase.
STREAMS = {"json+pcm": ("json", "pcm"), "h264+opus": ("h264", "opus")}
#: The measures that are compared, and their names.
_COMPARED = {MEMORY: "memory", CPU: "CPU", PER_PICTURE: "CPU per delivered picture", PICTURES: "pictures per second"}
_FLOW_S = 20.0
_STARTUP_S = 0.5  # for start-up work, or a change of the streams, to finish
_FIRST = 5  # pictures and sound packets until a stream counts as flowing


class Reading(NamedTuple):
    """One robot in one phase."""

    phase: str
    values: Mapping[str, Mapping[str, float]]  # by measure and process, in the unit of the measure
    pictures_per_s: float | None = None  # delivered to the operator; None: none were requested


def measure(case: Case) -> Iterator[Cell]:
    for reading in read(case.variant, case.run["seconds"]):
        yield from cells_of(case, reading)


def read(kind: str, seconds: float) -> Iterator[Reading]:
    """All phases of a fresh robot. Raises PebbleError with its log if a phase does not start."""
    with ready_robot(kind) as (robot, subscriber):
        yield _read(robot, subscriber, IDLE, seconds)
        with driving(robot.remote_port, BASE):
            yield _read(robot, subscriber, DRIVING, seconds)
        for name, forms in STREAMS.items():
            if "h264" in forms and find_spec("av") is None:
                continue
            subscriber.ask_for(*forms)
            robot.expect(partial(_flow, robot, subscriber, forms), f"{name} does not flow", _FLOW_S)
            yield _read(robot, subscriber, name, seconds)


def _flow(robot: Robot, subscriber: RobotSubscriber, forms: Sequence[str]) -> bool:
    return all(subscriber.arrived[form] >= _FIRST for form in forms) and robot.complete()


def _read(robot: Robot, subscriber: RobotSubscriber, phase: str, seconds: float) -> Reading:
    """Measures the robot's processes for some seconds; memory is read afterwards."""
    time.sleep(_STARTUP_S)
    processes, form = robot.processes(), STREAMS.get(phase, ("no pictures",))[0]
    before = {name: cpu_s([pid]) for name, pid in processes.items()}
    pictures, began = subscriber.arrived[form], time.monotonic()
    time.sleep(seconds)
    took = time.monotonic() - began
    cpu = {name: 100 * (cpu_s([pid]) - before[name]) / took for name, pid in processes.items()}
    arrived = subscriber.arrived[form] - pictures
    if robot.processes() != processes:
        raise PebbleError(f"{phase}: processes of the robot ended or started meanwhile\n{robot.log()}")
    memory = {name: pss_mb(pid) for name, pid in processes.items()}
    threads = {name: len(list(Path(f"/proc/{pid}/task").iterdir())) for name, pid in processes.items()}
    values = {MEMORY: memory, CPU: cpu, THREADS: threads}
    return Reading(phase, values, arrived / took if phase in STREAMS else None)


def cells_of(case: Case, reading: Reading) -> Iterator[Cell]:
    """By measure and process; and by picture the CPU time of the whole robot, including its sound."""
    params, rate = {"phase": reading.phase, "process": ALL}, reading.pictures_per_s
    for measure_, values in reading.values.items():
        for process, value in values.items():
            yield case.cell(measure_, _UNITS[measure_], [value], {**params, "process": process})
        yield case.cell(measure_, _UNITS[measure_], [sum(values.values())], params, processes=len(values))
    if rate is not None:
        yield case.cell(PICTURES, "1/s", [rate], params)
        yield case.cell(PER_PICTURE, "ms", [10 * sum(reading.values[CPU].values()) / rate] if rate else [], params)


COST = Comparison(
    name="cost",
    title="Memory and CPU",
    what="What each process of a robot needs while it is idle, driven, and streaming. Memory is PSS, in which "
    "shared pages are divided among their users; CPU is per cent of one core. `all` is the launcher with "
    "its children, on MQTT with the local mosquitto: not the remote broker, the operator and the simulated MCU.",
    help="""What a robot costs: memory, CPU and threads of each of its processes.

    Idle, driven 20 times a second, and sending pictures (640x480, 15 per second) and sound to an operator in two
    forms. Whole simulated robots; needs mosquitto.

    \b
        pebble bench cost
        pebble bench cost --variants zenoh --seconds 10
    """,
    options=(
        rounds("Robots of each variant."),
        seconds("Length of each phase.", least=0.4),
        variants(KINDS, "mqtt or zenoh."),
    ),
    full=Budget(180, rounds=8, seconds=1.5),
    quick=Budget(20, rounds=1, seconds=0.7),
    constants={"rate_hz": RATE_HZ},
    variants=KINDS,
    measure=measure,
    tables=(
        Grid(
            title="memory (PSS), CPU (of one core), threads; medians", rows=("phase", "process"), last=ALL,
            columns=(
                median_column("MB", MEMORY), median_column("%", CPU), median_column("thr.", THREADS, "{:.0f}".format),
            ),
        ),
    ),
    assessment=(
        Claims(
            what="{phase}, {quantity}",
            of=lambda cell: cell.params["process"] == ALL and cell.measure in _COMPARED,
            quantity=_COMPARED,
            judged=lambda cell: cell.params["process"] == ALL,
        ),
    ),
    pictures=(bars("What a robot costs", measures=(MEMORY, CPU), panel="phase", group="process"),),
    summary_lines=12,
)  # fmt: skip
