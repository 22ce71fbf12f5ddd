"""Measures the latency of drive commands to the wheels and of MCU reports to the operator, with whole robots.

A robot of each kind, with a stock broker between it and the operator, and ``stand-in``, two programs of plain paho in
place of the original; ``C floor``: such two in C (floor.c), which carry commands alone. ``down``: from the operator's
publish call to the last byte of the command's line at the MCU's pty; ``up``: from the MCU's report to the operator.
Under ``commands`` robots forward no reports. CPU is that of the process that bridges and of the one that owns the
serial line, for each command and report that they forwarded. Each round starts fresh robots and drives them in turns of
a second, backwards every other time. Commands and reports that take longer than a second are lost, and commands that a
newer one overtook.
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
from pebble.extensions.lab.bench.bridge_operator import ALL, Arrived, DrivenRobot, Turn, compiled, driven_robot
from pebble.extensions.lab.bench.results import FLOOR, STAND_IN, Cell, Results, begin, grouped, round_cell
from pebble.extensions.lab.bench.rounds import Progress, in_turn, measure_rounds
from pebble.extensions.lab.bench.show import RATIOS, Picture, Shown, compared, percentiles, plain_table, spread
from pebble.extensions.lab.rig.robot import KINDS

UNLOADED, COMMANDS = "none", "commands"  # unloaded: 20 commands and 50 reports a second
VARIANTS = (STAND_IN, FLOOR, *KINDS)
DOWN, UP, CPU = MEASURES = ("down", "up", "CPU per message")
STARTUP_S = 1.0  # for start-up work to finish


@dataclass(frozen=True, slots=True)
class Settings:
    """The course of the comparison: ``seconds`` per round and load, in turns of a second."""

    seconds: float = 12.5
    rounds: int = 20
    variants: Sequence[str] = VARIANTS


FULL: Final = Settings()
QUICK: Final = Settings(seconds=0.5, rounds=2)


def run(settings: Settings, console: Console) -> Shown:
    """Measure all variants. Raises PebbleError."""
    results = begin("bridge", settings)
    try:
        with tempfile.TemporaryDirectory() as folder:
            compiled(Path(folder, "floor"))
    except PebbleError as error:
        results.notes.append(str(error))
        settings = replace(settings, variants=[name for name in settings.variants if name != FLOOR])
    measure_rounds(results, settings.rounds, lambda number, progress: measure(settings, number, progress), console)
    results.cells.sort(key=lambda cell: MEASURES.index(cell.measure))
    latencies, cpu = ([cell for cell in results.cells if (cell.measure == CPU) == is_cpu] for is_cpu in (False, True))
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
        time.sleep(STARTUP_S)
        yield driven


def measure(settings: Settings, number: int, progress: Progress) -> Iterator[Cell]:
    """Yield the results of fresh robots with and without reports of their MCUs, each measured in turns of a second."""
    passes = max(1, round(settings.seconds))
    for load in in_turn((UNLOADED, COMMANDS), number):
        reports, turns = load == UNLOADED, list[tuple[str, Turn]]()
        progress("starting the robots")
        with running([name for name in settings.variants if name != FLOOR or not reports], reports=reports) as driven:
            for pass_ in range(passes):
                for variant in in_turn(list(driven), number + pass_):
                    progress(f"{variant}, {load}")
                    turns.append((variant, driven[variant].drive(settings.seconds / passes)))
            for variant, of_variant in grouped(turns, lambda turn: turn[0]).items():
                arrived = driven[variant].arrived([turn for _, turn in of_variant])
                for _, turn in of_variant:
                    yield from cells_of(variant, load, turn, arrived)


def cells_of(variant: str, load: str, turn: Turn, arrived: Arrived) -> Iterator[Cell]:
    params, took_s = {"load": load}, (turn.ended - turn.began) / 1e9
    figures = {"cpu_percent": 100 * turn.cpu_s[ALL] / took_s} if ALL in turn.cpu_s else {}
    down = [(arrived.commands[wheels] - ns) / 1e6 for wheels, ns in turn.sent.items() if wheels in arrived.commands]
    yield round_cell(variant, DOWN, "ms", down, params, sent=len(turn.sent), **figures)
    if load != COMMANDS:
        reports = [(sent, ns) for sent, ns in arrived.reports if turn.began <= sent <= turn.ended]
        yield round_cell(
            variant, UP, "ms", [(ns - sent) / 1e6 for sent, ns in reports if ns is not None], params, sent=len(reports)
        )
    forwarded = len(down) + sum(turn.began <= ns <= turn.ended for ns, _ in arrived.received)
    for process, cpu_s in turn.cpu_s.items():
        if process != ALL:
            cost = [1e6 * cpu_s / forwarded] if forwarded else []
            yield round_cell(variant, CPU, "us", cost, {**params, "process": process})


def latency_table(results: Results, cells: Sequence[Cell]) -> Table:
    """Return latencies of commands and reports, and the CPU of the whole robot."""
    grid = plain_table(
        "Commands down, reports up, ms; CPU of the whole robot, % of a core",
        ["way", "load", "variant", "p50", "p95", "p99", "max", "n", "lost", "CPU",
         *(f"p{percent} to {base}" for base in (STAND_IN, FLOOR) for percent in (50, 99))],
        left=3, caption=f"{STAND_IN}: plain paho in place of the original. {RATIOS}",
    )  # fmt: skip
    for (way, load), group in grouped(cells, lambda cell: (cell.measure, str(cell.params["load"]))).items():
        grid.add_section()
        for ours in group:
            bases = [results.find(name, way, load=load) for name in (STAND_IN, FLOOR)]
            cpu = f"{ours.middle('cpu_percent'):.1f}" if way == DOWN else ""
            place = (way, load) if ours is group[0] else ("", "")
            counts = (str(len(ours.samples)), str(ours.lost))
            grid.add_row(
                *place,
                ours.variant,
                *percentiles(ours, 50, 95, 99, 100),
                *counts,
                cpu,
                *(compared(ours, base, percent) for base in bases for percent in (50, 99)),
            )
    return grid


def cpu_table(results: Results, cells: Sequence[Cell]) -> Table:
    """Return the CPU time for each forwarded message."""
    grid = plain_table("CPU for each forwarded message, µs: median (minimum to maximum) of the rounds",
                        ["load", "process", "variant", "", f"to {STAND_IN}"], left=3, caption=RATIOS)  # fmt: skip
    for (load, process), group in grouped(cells, lambda cell: tuple(cell.params.values())).items():
        for ours in group:
            base = results.find(STAND_IN, CPU, load=load, process=process)
            place = (str(load), str(process)) if ours is group[0] else ("", "")
            grid.add_row(*place, ours.variant, spread(ours), compared(ours, base))
    return grid
