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

from pebble.bench.clients import RATE_HZ, RobotSubscriber, driving, ready_robot
from pebble.bench.comparison import Budget, Case, Comparison, Measuring, Report, rounds, seconds, variants
from pebble.bench.pictures import bars
from pebble.bench.results import Cell
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


def measure(case: Case) -> Iterator[Cell]:
    """All phases of a fresh robot. Raises PebbleError with its log if a phase does not start."""
    with ready_robot(case.variant) as (robot, subscriber):
        yield from _phase(case, robot, subscriber, IDLE)
        with driving(robot.remote_port, BASE):
            yield from _phase(case, robot, subscriber, DRIVING)
        for name, forms in STREAMS.items():
            if "h264" in forms and find_spec("av") is None:
                continue
            subscriber.request_media(BASE, True, *forms)
            robot.expect(partial(_flow, robot, subscriber, forms), f"{name} does not flow", _FLOW_S)
            yield from _phase(case, robot, subscriber, name)


def _flow(robot: Robot, subscriber: RobotSubscriber, forms: Sequence[str]) -> bool:
    return all(subscriber.arrived[form] >= _FIRST for form in forms) and robot.complete()


def _phase(case: Case, robot: Robot, subscriber: RobotSubscriber, phase: str) -> Iterator[Cell]:
    """Measures the robot's processes for some seconds; memory is read afterwards."""
    time.sleep(_STARTUP_S)
    processes, form = robot.processes(), STREAMS.get(phase, ("no pictures",))[0]
    before = {name: cpu_s([pid]) for name, pid in processes.items()}
    pictures, began = subscriber.arrived[form], time.monotonic()
    time.sleep(case.run["seconds"])
    took = time.monotonic() - began
    cpu = {name: 100 * (cpu_s([pid]) - before[name]) / took for name, pid in processes.items()}
    rate = (subscriber.arrived[form] - pictures) / took if phase in STREAMS else None
    if robot.processes() != processes:
        raise PebbleError(f"{phase}: processes of the robot ended or started meanwhile\n{robot.log()}")
    memory = {name: pss_mb(pid) for name, pid in processes.items()}
    threads = {name: len(list(Path(f"/proc/{pid}/task").iterdir())) for name, pid in processes.items()}
    yield from cells_of(case, phase, {MEMORY: memory, CPU: cpu, THREADS: threads}, rate)


def cells_of(
    case: Case, phase: str, found: Mapping[str, Mapping[str, float]], pictures_per_s: float | None = None
) -> Iterator[Cell]:
    """Cells of what was ``found``, by measure and process; and the CPU time of the robot and its sound by picture."""
    params = {"phase": phase, "process": ALL}
    for name, values in found.items():
        for process, value in values.items():
            yield case.cell(name, _UNITS[name], [value], {**params, "process": process})
        yield case.cell(name, _UNITS[name], [sum(values.values())], params, processes=len(values))
    if pictures_per_s is not None:
        per_picture = [10 * sum(found[CPU].values()) / pictures_per_s] if pictures_per_s else []
        yield case.cell(PICTURES, "1/s", [pictures_per_s], params)
        yield case.cell(PER_PICTURE, "ms", per_picture, params)


COST = Comparison(
    name="cost",
    title="Memory and CPU",
    what="What each process of a robot needs while it is idle, driven, and streaming. Memory is PSS, in which "
    "shared pages are divided among their users; CPU is per cent of one core. `all` is the launcher with "
    "its children, on MQTT with the local mosquitto: not the remote broker, the operator and the simulated MCU.",
    help="""What a robot costs: memory, CPU and threads of each of its processes.

    Idle, driven 20 times a second, and sending pictures (640x480, 15 per second) and sound to an operator in two
    forms. Whole simulated robots; needs mosquitto.
    """,
    options=(rounds("Robots of each variant."), seconds("Of each phase.", least=0.4), variants(KINDS)),
    full=Budget(180, rounds=8, seconds=1.5),
    quick=Budget(20, rounds=1, seconds=0.7),
    constants={"rate_hz": RATE_HZ},
    variants=KINDS,
    measuring=Measuring(
        prepare=lambda run: run.notes.extend([] if find_spec("av") else ["h264+opus is left out: there is no PyAV"]),
        measure=measure,
    ),
    report=Report(
        tables=(
            Grid(
                title="memory (PSS), CPU (of one core), threads; medians", rows=("phase", "process"), last=ALL,
                columns=(
                    median_column("MB", MEMORY), median_column("%", CPU),
                    median_column("thr.", THREADS, "{:.0f}".format),
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
    ),
)  # fmt: skip
