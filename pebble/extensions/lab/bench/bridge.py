"""Measures the latency of drive commands to the wheels and of MCU reports to the operator, with whole robots.

A robot of each kind, with a stock broker between it and the operator; ``stand-in``: two programs of plain paho in
place of the original Pebble; ``C floor``: two such programs in C (floor.c), which carry commands alone. ``down``: from
the operator's publish call to the last byte of the command's line at the MCU's pty; ``up``: from the MCU's report to
the operator. Under ``commands`` robots forward no reports. CPU is that of the process that bridges and of the one that
owns the serial line, for each command and report that they forwarded. Each round starts fresh robots. They
are driven in turns of a second, one after another; every other time in reverse order. Commands and reports that take
longer than a second count as lost, and so do commands that a newer one overtook.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from rich.console import Console
from rich.table import Table

from pebble.errors import PebbleError
from pebble.extensions.lab.bench import plots
from pebble.extensions.lab.bench.bridge_operator import Arrived, DrivenRobot, Turn, compiled, driven_robot
from pebble.extensions.lab.bench.results import FLOOR, STAND_IN, Cell, Results, begin, grouped, round_cell
from pebble.extensions.lab.bench.rounds import Progress, in_turn, measure_rounds
from pebble.extensions.lab.bench.show import RATIOS, Picture, Shown, compared, percentiles, plain_table, spread
from pebble.extensions.lab.rig.robot import KINDS

REPORTS, COMMANDS = "none", "commands"  # loads: the first is a robot's usual one, 20 commands and 50 reports a second
VARIANTS = (STAND_IN, FLOOR, *KINDS)
DOWN, UP, CPU = MEASURES = ("down", "up", "CPU per message")
STARTUP_S = 1.0  # for start-up work to finish


@dataclass(frozen=True, slots=True)
class Settings:
    """The course of the comparison. ``seconds``: how long each robot is driven in a round, with and without reports."""

    seconds: float = 12.5
    rounds: int = 20
    variants: Sequence[str] = VARIANTS


FULL: Final = Settings()
QUICK: Final = Settings(seconds=0.5, rounds=2)


def run(settings: Settings, console: Console) -> Shown:
    """Measure all variants. Raises PebbleError."""
    results = begin("bridge", settings)
    try:
        with tempfile.TemporaryDirectory() as folder:  # a trial: each robot compiles its own
            compiled(Path(folder, "floor"))
    except PebbleError as error:
        results.notes.append(str(error))
        settings = replace(settings, variants=[name for name in settings.variants if name != FLOOR])
    measure_rounds(results, settings.rounds, lambda number, progress: measure(settings, number, progress), console)
    results.cells.sort(key=lambda cell: MEASURES.index(cell.measure))
    cpu = [cell for cell in results.cells if cell.measure == CPU]
    latencies = [cell for cell in results.cells if cell.measure != CPU]
    pictures = list[Picture]()
    for way in (DOWN, UP):
        cells = [cell for cell in latencies if cell.measure == way]
        pictures += plots.curves(f"bridge-{way}", f"Operator to wheels and back: {way}", cells)
    return Shown(results, [latency_table(results, latencies), cpu_table(results, cpu)], pictures)


@contextmanager
def running(variants: Sequence[str], *, reports: bool) -> Iterator[dict[str, DrivenRobot]]:
    """Start fresh robots and yield them once they are ready; with ``reports`` they forward their MCUs' reports."""
    with ExitStack() as stack:
        driven = {kind: stack.enter_context(driven_robot(kind, reports=reports)) for kind in variants}
        for robot in driven.values():
            robot.wait_until_ready()
        time.sleep(STARTUP_S)  # a service that is ready may still have work of its start
        yield driven


def measure(settings: Settings, number: int, progress: Progress) -> Iterator[Cell]:
    """Yield the results of fresh robots with and without reports of their MCUs, each measured in turns of a second."""
    passes = max(1, round(settings.seconds))
    for load in in_turn((REPORTS, COMMANDS), number):
        variants = [name for name in settings.variants if name != FLOOR or load == COMMANDS]  # FLOOR: no reports
        turns: dict[str, list[Turn]] = {variant: [] for variant in variants}
        progress("starting the robots")
        with running(variants, reports=load == REPORTS) as driven:
            for pass_ in range(passes):
                for variant in in_turn(variants, number + pass_):
                    progress(f"{variant}, {load}")
                    turns[variant].append(driven[variant].drive(settings.seconds / passes))
            for variant, turns_of_variant in turns.items():
                arrived = driven[variant].arrived(turns_of_variant)
                for turn in turns_of_variant:
                    yield from cells_of(variant, load, turn, arrived)


def cells_of(variant: str, load: str, turn: Turn, arrived: Arrived) -> Iterator[Cell]:
    """Yield the latencies of a turn, and the CPU time for each message. ``arrived``: what came in all turns.

    Each command has wheel speeds that no other has, by which it is found again.
    """
    params = {"load": load}
    down = [(arrived.commands[wheels] - ns) / 1e6 for wheels, ns in turn.sent.items() if wheels in arrived.commands]
    yield round_cell(variant, DOWN, "ms", down, params, sent=len(turn.sent))
    if load == REPORTS:
        reports = [report for report in arrived.reports if turn.began <= report.sent_ns <= turn.ended]
        up = [(report.received_ns - report.sent_ns) / 1e6 for report in reports if report.received_ns is not None]
        yield round_cell(variant, UP, "ms", up, params, sent=len(reports))
    # CPU time is shared by all reports that arrive in the turn. `reports` above has only those whose latency is known:
    # their values were sent once.
    received = [ns for ns, _ in arrived.received if turn.began <= ns <= turn.ended]
    forwarded = len(down) + len(received)
    for process, cpu_s in turn.cpu_s.items():
        cost = [1e6 * cpu_s / forwarded] if forwarded else []
        yield round_cell(variant, CPU, "us", cost, {**params, "process": process})


def latency_table(results: Results, cells: Sequence[Cell]) -> Table:
    """Return the latencies of commands and reports."""
    grid = plain_table(
        "Commands down, reports up, ms",
        ["way", "load", "variant", "p50", "p95", "p99", "max", "n", "lost",
         *(f"p{percent} to {base}" for base in (STAND_IN, FLOOR) for percent in (50, 99))],
        left=3, caption=f"{STAND_IN}: plain paho in place of the original. {RATIOS}",
    )  # fmt: skip
    for (way, load), group in grouped(cells, lambda cell: (cell.measure, str(cell.params["load"]))).items():
        grid.add_section()
        for ours in group:
            bases = [results.find(name, way, load=load) for name in (STAND_IN, FLOOR)]
            place = (way, load) if ours is group[0] else ("", "")
            counts = (str(len(ours.samples)), str(ours.lost))
            ratios = [compared(ours, base, percent) for base in bases for percent in (50, 99)]
            grid.add_row(*place, ours.variant, *percentiles(ours, 50, 95, 99, 100), *counts, *ratios)
    return grid


def cpu_table(results: Results, cells: Sequence[Cell]) -> Table:
    """Return the CPU time for each forwarded message."""
    grid = plain_table("CPU for each forwarded message, µs: median (minimum to maximum) of the rounds",
                        ["load", "process", "variant", "", f"to {STAND_IN}"], left=3, caption=RATIOS)  # fmt: skip
    # by all parameters, which cells_of gives in this order
    for (load, process), group in grouped(cells, lambda cell: tuple(cell.params.values())).items():
        for ours in group:
            base = results.find(STAND_IN, CPU, load=load, process=process)
            place = (str(load), str(process)) if ours is group[0] else ("", "")
            grid.add_row(*place, ours.variant, spread(ours), compared(ours, base))
    return grid
