"""The table and the assessment of robots' costs. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import median

from rich.table import Table

from pebble.bench.cost_cells import ALL, CPU, MEMORY, PER_PICTURE, PICTURES, THREADS
from pebble.bench.results import Cell
from pebble.bench.robot_comparison import caveat, medians, sentence
from pebble.bench.tables import figure, plain_table
from pebble.rig.robot import BROKER, LAUNCHER

_COLUMNS = ((MEMORY, "MB"), (CPU, "%"), (THREADS, "thr."))
#: The measures that are compared, and their names.
_COMPARED = ((MEMORY, "memory"), (CPU, "CPU"), (PER_PICTURE, "CPU per delivered picture"))


def table(cells: Sequence[Cell]) -> Table:
    """Rows are phases and processes, columns transports; medians of the rounds."""
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
    """What the sum includes, and the rate of delivered pictures."""
    lines = [
        f"{ALL}: {LAUNCHER} and its children; on mqtt also {BROKER}, the local broker."
        " Without the remote broker, the operator and the simulated MCU."
    ]
    for phase in _phases(cells):
        rates = [f"{cell.variant} {_median(cell)}" for cell in _pair(cells, phase, PICTURES)]
        lines += [f"{phase}: pictures per second that reached the operator: {', '.join(rates)}"] if rates else []
    return lines


def assessment(cells: Sequence[Cell]) -> list[str]:
    """Compares the robots' memory and CPU, phase by phase."""
    lines = [
        sentence(f"{phase}, {what}", pair, quantity=what)
        for phase in _phases(cells)
        for measure, what in _COMPARED
        if (pair := _pair(cells, phase, measure))
    ]
    return lines + caveat([cell for cell in cells if cell.params["process"] == ALL])


def _pair(cells: Sequence[Cell], phase: str, measure: str) -> list[Cell]:
    """The sum over all processes, for each kind of robot."""
    return [cell for kind in _kinds(cells) if (cell := _find(cells, kind, phase, ALL, measure)) is not None]


def _find(cells: Sequence[Cell], kind: str, phase: str, process: str, measure: str) -> Cell | None:
    wanted = {"phase": phase, "process": process}
    return next(
        (cell for cell in cells if cell.variant == kind and cell.measure == measure and cell.params == wanted), None
    )


def _median(cell: Cell | None) -> str:
    """The median as text; empty for a process that this robot does not have."""
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
    """The processes of all kinds; the sum comes last."""
    names = dict.fromkeys(str(cell.params["process"]) for cell in cells if cell.params["phase"] == phase)
    return [*(name for name in names if name != ALL), ALL]
