"""Measures memory, CPU and threads of each process of a robot, idle and active, on MQTT and on Zenoh.

Whole robots with a synthetic camera and microphone, stock mosquitto, a simulated MCU. The phases have a fixed order;
each starts with the memory that the one before left allocated. Memory is PSS, in which shared pages are divided among
their users, CPU is per cent of one core. ``all`` is the launcher with its children, and on MQTT the local mosquitto:
not the remote broker, the operator and the MCU. Nothing large is imported here, since that would reduce a robot's PSS.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from rich.console import Console
from rich.table import Table

from pebble.errors import PebbleError
from pebble.extensions.lab.bench.clients import RobotSubscriber, driving, ready_robot
from pebble.extensions.lab.bench.results import Cell, Results, begin, round_cell
from pebble.extensions.lab.bench.rounds import Progress, in_turn, measure_rounds
from pebble.extensions.lab.bench.show import RATIOS, Shown, compared, middle, plain_table
from pebble.extensions.lab.bench.usage import cpu_s, pss_mb
from pebble.extensions.lab.rig.robot import BASE, KINDS, Robot

ALL: Final = "all"  # the processes of a robot together
MEMORY, CPU, THREADS = "PSS", "CPU", "threads"
PICTURES, PER_PICTURE = "pictures", "CPU per picture"
IDLE, DRIVING = "idle", "driving"
_UNITS = {MEMORY: "MB", CPU: "%", THREADS: ""}
#: The encodings requested in each media phase, by the name of the phase.
STREAMS: Final = {"json+pcm": ("json", "pcm"), "h264+opus": ("h264", "opus")}
_FLOW_S = 20.0
_STARTUP_S = 0.5  # for start-up work, or a change of the streams, to finish
_FIRST = 5  # pictures and sound packets until a stream counts as flowing


@dataclass(frozen=True, slots=True)
class Settings:
    """Robots of each variant, one in each round, and seconds of each phase."""

    variants: Sequence[str] = KINDS
    seconds: float = 1.5
    rounds: int = 8


FULL: Final = Settings()
QUICK: Final = Settings(seconds=0.7, rounds=1)


def run(settings: Settings, console: Console) -> Shown:
    """Measure all variants. Raises PebbleError."""
    results = begin("cost", settings)
    if find_spec("av") is None:
        results.notes.append("h264+opus is left out: there is no PyAV")

    def measure_round(number: int, progress: Progress) -> Iterator[Cell]:
        for variant in in_turn(settings.variants, number):
            progress(variant)
            yield from measure(variant, settings.seconds)

    measure_rounds(results, settings.rounds, measure_round, console)
    return shown(results)


def shown(results: Results) -> Shown:
    """Return results with their tables."""
    return Shown(results, [table(results), whole(results)])


def measure(variant: str, seconds: float) -> Iterator[Cell]:
    """Measure all phases of a fresh robot. Raises PebbleError with its log if a phase does not start."""
    with ready_robot(variant) as (robot, subscriber):
        yield from _phase(robot, subscriber, IDLE, seconds)
        with driving(robot.remote_port, BASE):
            yield from _phase(robot, subscriber, DRIVING, seconds)
        for name, forms in STREAMS.items():
            if "h264" in forms and find_spec("av") is None:
                continue
            subscriber.request_media(BASE, True, *forms)
            robot.expect(partial(_flow, robot, subscriber, forms), f"{name} does not flow", _FLOW_S)
            yield from _phase(robot, subscriber, name, seconds)


def _flow(robot: Robot, subscriber: RobotSubscriber, forms: Sequence[str]) -> bool:
    return all(subscriber.arrived[form] >= _FIRST for form in forms) and robot.complete()


def _phase(robot: Robot, subscriber: RobotSubscriber, phase: str, seconds: float) -> Iterator[Cell]:
    """Measure the robot's processes for some seconds; memory is read afterwards."""
    time.sleep(_STARTUP_S)
    processes, form = robot.processes(), STREAMS.get(phase, ("no pictures",))[0]
    before = {name: cpu_s([pid]) for name, pid in processes.items()}
    pictures, began = subscriber.arrived[form], time.monotonic()
    time.sleep(seconds)
    took = time.monotonic() - began
    cpu = {name: 100 * (cpu_s([pid]) - before[name]) / took for name, pid in processes.items()}
    rate = (subscriber.arrived[form] - pictures) / took if phase in STREAMS else None
    if robot.processes() != processes:
        raise PebbleError(f"{phase}: processes of the robot ended or started meanwhile\n{robot.log()}")
    memory = {name: pss_mb(pid) for name, pid in processes.items()}
    threads = {name: len(list(Path(f"/proc/{pid}/task").iterdir())) for name, pid in processes.items()}
    yield from cells_of(robot.kind, phase, {MEMORY: memory, CPU: cpu, THREADS: threads}, rate)


def cells_of(
    variant: str, phase: str, used: Mapping[str, Mapping[str, float]], pictures_hz: float | None = None
) -> Iterator[Cell]:
    """Yield what was ``used``, by measure and process; and the CPU time of the robot and its sound by picture."""
    params = {"phase": phase, "process": ALL}
    for name, values in used.items():
        for process, value in values.items():
            yield round_cell(variant, name, _UNITS[name], [value], {**params, "process": process})
        yield round_cell(variant, name, _UNITS[name], [sum(values.values())], params)
    if pictures_hz is not None:
        per_picture = [10 * sum(used[CPU].values()) / pictures_hz] if pictures_hz else []
        yield round_cell(variant, PICTURES, "1/s", [pictures_hz], params)
        yield round_cell(variant, PER_PICTURE, "ms", per_picture, params)


def table(results: Results) -> Table:
    """Return what each process needs, by phase; the whole robot last, in bold."""
    heads = [f"{variant} {unit}" for variant in KINDS for unit in ("MB", "%", "thr.")]
    grid = plain_table("Memory (PSS), CPU (of one core), threads; medians", ["phase", "process", *heads], left=2)
    for phase in dict.fromkeys(str(cell.params["phase"]) for cell in results.cells):
        grid.add_section()
        found = dict.fromkeys(str(cell.params["process"]) for cell in results.cells if cell.params["phase"] == phase)
        for number, process in enumerate(sorted(found, key=lambda name: name == ALL)):
            of_all = [
                middle(results.find(variant, measure_, phase=phase, process=process))
                for variant in KINDS
                for measure_ in (MEMORY, CPU, THREADS)
            ]
            grid.add_row("" if number else phase, process, *of_all, style="bold" if process == ALL else None)
    return grid


def whole(results: Results) -> Table:
    """Return what the whole robots need, as ratios."""
    ours, theirs = "zenoh", "mqtt"
    grid = plain_table("Whole robots", ["phase", "", "unit", theirs, ours, f"{ours} / {theirs}"], left=3,
                        caption=RATIOS)  # fmt: skip
    for mqtt in (cell for cell in results.cells if (cell.variant, cell.params["process"]) == (theirs, ALL)):
        zenoh = results.find(ours, mqtt.measure, **mqtt.params)
        grid.add_row(
            str(mqtt.params["phase"]), mqtt.measure, mqtt.unit, middle(mqtt), middle(zenoh), compared(zenoh, mqtt)
        )
    return grid
