"""Figures of two robots, one on each transport, as people read them."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median

from pebble.bench.figures import percentile
from pebble.bench.ratios import LEAST_ROUNDS, LEVEL, paired
from pebble.bench.results import Cell
from pebble.bench.tables import figure

_LEAST_APART = 5  # rounds: with three, equal robots lie wholly apart in one run of ten, with five in one of 126


def medians(cell: Cell) -> list[float]:
    """Of each round that has samples."""
    return [percentile(one, 50) for one in cell.rounds if one]


def spread(cell: Cell) -> str:
    """``0.34 (0.31 to 0.39)``: the median of the rounds, and their least and greatest where there are several."""
    rounds = medians(cell)
    if not rounds:
        return "–"
    middle = figure(median(rounds))
    return middle if len(rounds) == 1 else f"{middle} ({figure(min(rounds))} to {figure(max(rounds))})"


def sentence(what: str, cells: Sequence[Cell], *, less: str, more: str) -> str:
    """How the robots compare in one measure, for those who run them; ``less`` and ``more`` as in "sooner" and "later".

    ``cells`` are one or two, the one to be compared with first.
    """
    unit = f" {cells[0].unit}" if cells[0].unit else ""
    figures = ", ".join(f"{cell.variant} {spread(cell)}{unit}" for cell in cells)
    if len(cells) < 2:
        return f"{what}: {figures}"
    theirs, ours = cells
    if enough(cells):
        words = paired(ours.rounds, theirs.rounds).words(ours.variant, theirs.variant, what=more, less=less)
        return f"{what}: {words}; {figures}"
    return f"{what}: {figures}{_few(ours, theirs, less)}"


def against(cells: Sequence[Cell]) -> str:
    """The second robot's figure divided by the first's, with an interval where there are rounds for one."""
    interval = paired(cells[1].rounds, cells[0].rounds)
    return str(interval) if enough(cells) else figure(interval.ratio)


def enough(cells: Sequence[Cell]) -> bool:
    """For an interval that means something."""
    return all(len(medians(cell)) >= LEAST_ROUNDS for cell in cells)


def caveat(cells: Sequence[Cell]) -> list[str]:
    """What to say below sentences without intervals."""
    if enough(cells):
        return []
    few = min(len(medians(cell)) for cell in cells)
    if few < 2:
        return [f"One round is no comparison; an interval of {100 * LEVEL:.0f} % takes {LEAST_ROUNDS}."]
    return [
        f"{few} rounds, and an interval of {100 * LEVEL:.0f} % takes {LEAST_ROUNDS}:"
        " these are medians, in brackets the least and the greatest."
    ]


def _few(ours: Cell, theirs: Cell, less: str) -> str:
    """Where the rounds of one lie all below those of the other."""
    a, b = medians(ours), medians(theirs)
    if min(len(a), len(b)) < _LEAST_APART:
        return ""
    if max(a) < min(b):
        return f": {ours.variant} is {less} in every round"
    return f": {theirs.variant} is {less} in every round" if max(b) < min(a) else ": not told apart"
