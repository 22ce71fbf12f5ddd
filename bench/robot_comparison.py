"""Formats the results of two robots, one on each transport, for tables and sentences."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median

from pebble.bench.percentiles import percentile
from pebble.bench.ratios import LEAST_ROUNDS, LEVEL, paired
from pebble.bench.results import Cell
from pebble.bench.tables import figure

_LEAST_APART = 5  # rounds: with three, equal robots are disjoint in one run of ten, with five in one of 126


def medians(cell: Cell) -> list[float]:
    """The median of each round that has samples."""
    return [percentile(one, 50) for one in cell.rounds if one]


def spread(cell: Cell) -> str:
    """``0.34 (0.31 to 0.39)``: the median of the rounds, and their minimum and maximum if there are several."""
    rounds = medians(cell)
    if not rounds:
        return "–"
    middle = figure(median(rounds))
    return middle if len(rounds) == 1 else f"{middle} ({figure(min(rounds))} to {figure(max(rounds))})"


def sentence(what: str, cells: Sequence[Cell], *, quantity: str) -> str:
    """Compares the robots in one measure; ``quantity`` as in "takes 0.9× the time".

    ``cells`` are one or two, the baseline first.
    """
    unit = f" {cells[0].unit}" if cells[0].unit else ""
    values = ", ".join(f"{cell.variant} {spread(cell)}{unit}" for cell in cells)
    if len(cells) < 2:
        return f"{what}: {values}"
    theirs, ours = cells
    if enough(cells):
        words = paired(ours.rounds, theirs.rounds).words(ours.variant, theirs.variant, quantity)
        return f"{what}: {words}; {values}"
    return f"{what}: {values}{_without_interval(ours, theirs, quantity)}"


def against(cells: Sequence[Cell]) -> str:
    """The second robot's value divided by the first's, with an interval if there are enough rounds."""
    interval = paired(cells[1].rounds, cells[0].rounds)
    return str(interval) if enough(cells) else figure(interval.ratio)


def enough(cells: Sequence[Cell]) -> bool:
    """Whether there are enough rounds for an interval."""
    return all(len(medians(cell)) >= LEAST_ROUNDS for cell in cells)


def caveat(cells: Sequence[Cell]) -> list[str]:
    """A note below sentences without intervals."""
    if enough(cells):
        return []
    few = min(len(medians(cell)) for cell in cells)
    if few < 2:
        return [f"One round is not enough to compare; a {100 * LEVEL:.0f} % interval needs {LEAST_ROUNDS}."]
    return [
        f"{few} rounds, and a {100 * LEVEL:.0f} % interval needs {LEAST_ROUNDS}:"
        " these are medians, with minimum and maximum."
    ]


def _without_interval(ours: Cell, theirs: Cell, quantity: str) -> str:
    """States whether all rounds of one robot lie below those of the other."""
    a, b = medians(ours), medians(theirs)
    if min(len(a), len(b)) < _LEAST_APART:
        return ""
    if max(a) < min(b):
        return f": {ours.variant} takes less {quantity} in every round"
    return f": {theirs.variant} takes less {quantity} in every round" if max(b) < min(a) else ": no clear difference"
