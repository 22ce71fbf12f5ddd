"""Measures memory and CPU of each process of a robot, idle and active, on MQTT and on Zenoh.

Whole robots with a synthetic camera and microphone, stock mosquitto, a simulated MCU. The phases have a fixed order;
each starts with the memory that the one before left allocated. Memory is PSS, in which shared pages are divided among
their users, CPU is per cent of one core. ``all`` is the launcher with its children, and on MQTT the local mosquitto:
not the remote broker, the operator and the MCU. Nothing large is imported here, since that would reduce a robot's PSS.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Final

from rich.console import Console
from rich.table import Table

from pebble.contract import AUDIO, CAMERA
from pebble.errors import PebbleError
from pebble.extensions.lab.bench.clients import UP_S, RobotSubscriber, driving
from pebble.extensions.lab.bench.results import Cell, Results, begin, grouped, round_cell
from pebble.extensions.lab.bench.rounds import Progress, in_turn, measure_rounds
from pebble.extensions.lab.bench.show import RATIOS, Shown, compared, middle, plain_table
from pebble.extensions.lab.bench.usage import cpu_s, pss_mb
from pebble.extensions.lab.rig.robot import BASE, KINDS, MEDIA, Robot, one_robot

ALL: Final = "all"  # the processes of a robot together
MEMORY, CPU = "PSS", "CPU"
IDLE, DRIVING, STREAMING = "idle", "driving", "h264+opus"
_UNITS = {MEMORY: "MB", CPU: "%"}
_FLOW_S = 20.0
_STARTUP_S = 0.5  # for start-up work, or a change of the streams, to finish
_FIRST = 5  # pictures and sound packets until a stream counts as flowing


@dataclass(frozen=True, slots=True)
class Settings:
    """The number of robots of each variant, one per round, and the seconds of each phase."""

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
        for variant in in_turn(KINDS, number):
            progress(variant)
            yield from measure(variant, settings.seconds)

    measure_rounds(results, settings.rounds, measure_round, console)
    return Shown(results, [table(results)])


def measure(variant: str, seconds: float) -> Iterator[Cell]:
    """Yield the results of all phases of a fresh robot. Raises PebbleError with its log if a phase does not start."""
    with one_robot(variant, services=MEDIA) as robot, closing(RobotSubscriber(robot.remote_port, BASE)) as subscriber:
        subscriber.wait()
        robot.launch()
        robot.expect(lambda: subscriber.ready_ns is not None, "not every service is ready", UP_S)
        yield from _phase(robot, IDLE, seconds)
        with driving(robot.remote_port, BASE):
            yield from _phase(robot, DRIVING, seconds)
        if find_spec("av") is not None:
            subscriber.request_media(BASE)
            robot.expect(lambda: _media_flow(robot, subscriber), "pictures or sound do not flow", _FLOW_S)
            yield from _phase(robot, STREAMING, seconds)


def _media_flow(robot: Robot, subscriber: RobotSubscriber) -> bool:
    arrived = (subscriber.arrived[channel.suffix] for channel in (CAMERA, AUDIO))
    return min(arrived) >= _FIRST and robot.complete()


def _phase(robot: Robot, phase: str, seconds: float) -> Iterator[Cell]:
    """Yield the usage of the robot's processes during some seconds; memory is read afterwards."""
    time.sleep(_STARTUP_S)
    processes, began = robot.processes(), time.monotonic()
    before = {name: cpu_s([pid]) for name, pid in processes.items()}
    time.sleep(seconds)
    took = time.monotonic() - began
    cpu = {name: 100 * (cpu_s([pid]) - before[name]) / took for name, pid in processes.items()}
    if robot.processes() != processes:
        raise PebbleError(f"{phase}: processes of the robot ended or started meanwhile\n{robot.log()}")
    memory = {name: pss_mb(pid) for name, pid in processes.items()}
    for measure_, by_process in ((MEMORY, memory), (CPU, cpu)):
        for process, value in (*by_process.items(), (ALL, sum(by_process.values()))):
            params = {"phase": phase, "process": process}
            yield round_cell(robot.kind, measure_, _UNITS[measure_], [value], params)


def table(results: Results) -> Table:
    """Return the usage of each process by phase, and the ratios; the whole robot last, in bold."""
    heads = [f"{variant} {unit}" for variant in KINDS for unit in _UNITS.values()]
    ratios = [f"{measure_}, zenoh / mqtt" for measure_ in _UNITS]
    grid = plain_table("Memory (PSS), CPU (of one core); medians", ["phase", "process", *heads, *ratios], left=2,
                        caption=RATIOS)  # fmt: skip
    for phase, cells in grouped(results.cells, lambda cell: cell.params["phase"]).items():
        grid.add_section()
        processes = sorted({str(cell.params["process"]) for cell in cells}, key=lambda name: (name == ALL, name))
        for number, process in enumerate(processes):
            mqtt, zenoh = (
                [results.find(variant, measure_, phase=phase, process=process) for measure_ in _UNITS]
                for variant in KINDS
            )
            comparisons = map(compared, zenoh, mqtt)
            shown_phase = str(phase) if number == 0 else ""  # once for all its processes
            style = "bold" if process == ALL else None
            grid.add_row(shown_phase, process, *map(middle, (*mqtt, *zenoh)), *comparisons, style=style)
    return grid
