"""The cost of robots as people read it. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import median

from rich.table import Table

from pebble.bench.cost_cells import ALL, CPU, MEMORY, PER_PICTURE, PICTURES, THREADS
from pebble.bench.measured_robot import BROKER, LAUNCHER
from pebble.bench.results import Cell
from pebble.bench.side_by_side import caveat, medians, sentence
from pebble.bench.tables import figure, plain_table

_COLUMNS = ((MEMORY, "MB"), (CPU, "%"), (THREADS, "thr."))
#: What the verdict is about: in which words, and what a robot is that needs less, or more.
_SAID = (
    (MEMORY, "memory", "smaller", "larger"),
    (CPU, "CPU", "lighter", "heavier"),
    (PER_PICTURE, "CPU for each picture delivered", "lighter", "heavier"),
)


def table(cells: Sequence[Cell]) -> Table:
    """Processes down, transports across, phase after phase; medians of the rounds."""
    kinds = _kinds(cells)
    heads = [f"{kind} {head}" for kind in kinds for _, head in _COLUMNS]
    rows = plain_table("memory (PSS), CPU (of one core), threads", ["phase", "process", *heads], left=2)
    for phase in _phases(cells):
        for number, process in enumerate(_processes(cells, phase)):
            found = [_find(cells, kind, phase, process, measure) for kind in kinds for measure, _ in _COLUMNS]
            style = "bold" if process == ALL else None
            rows.add_row("" if number else phase, process, *map(_median, found), style=style)
        rows.add_section()
    return rows


def legend(cells: Sequence[Cell]) -> list[str]:
    """What the sum holds, and how many pictures came."""
    lines = [
        f"{ALL}: {LAUNCHER} and its children; on mqtt also {BROKER}, the robot's own broker."
        " Not: the remote broker, the operator, the simulated MCU."
    ]
    for phase in _phases(cells):
        rates = [f"{cell.variant} {_median(cell)}" for cell in _pair(cells, phase, PICTURES)]
        lines += [f"{phase}: pictures per second that reached the operator: {', '.join(rates)}"] if rates else []
    return lines


def verdict(cells: Sequence[Cell]) -> list[str]:
    """Which robot needs less of what, phase by phase."""
    lines = [
        sentence(f"{phase}, {what}", pair, less=less, more=more)
        for phase in _phases(cells)
        for measure, what, less, more in _SAID
        if (pair := _pair(cells, phase, measure))
    ]
    return lines + caveat([cell for cell in cells if cell.params["process"] == ALL])


def _pair(cells: Sequence[Cell], phase: str, measure: str) -> list[Cell]:
    """Of each kind of robot, its sum."""
    return [cell for kind in _kinds(cells) if (cell := _find(cells, kind, phase, ALL, measure)) is not None]


def _find(cells: Sequence[Cell], kind: str, phase: str, process: str, measure: str) -> Cell | None:
    wanted = {"phase": phase, "process": process}
    return next(
        (cell for cell in cells if cell.variant == kind and cell.measure == measure and cell.params == wanted), None
    )


def _median(cell: Cell | None) -> str:
    """Empty for a process that this robot does not have."""
    if cell is None:
        return ""
    rounds = medians(cell)
    middle = median(rounds) if rounds else math.nan
    return f"{middle:.0f}" if cell.measure == THREADS else figure(middle)


def _kinds(cells: Sequence[Cell]) -> list[str]:
    return list(dict.fromkeys(cell.variant for cell in cells))


def _phases(cells: Sequence[Cell]) -> list[str]:
    return list(dict.fromkeys(str(cell.params["phase"]) for cell in cells))


def _processes(cells: Sequence[Cell], phase: str) -> list[str]:
    """Of all kinds; the sum last."""
    names = dict.fromkeys(str(cell.params["process"]) for cell in cells if cell.params["phase"] == phase)
    return [*(name for name in names if name != ALL), ALL]
