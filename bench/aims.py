"""Aims of a comparison: declared beside it, judged from its cells, stored and reported as what they are. Pure."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from pebble.bench.results import Cell, Judged, percentile
from pebble.bench.tables import figure

MET, MISSED, NOT_JUDGED = "met", "missed", "not judged"


def with_lost(percent: float) -> Callable[[Cell], float]:
    """A percentile in which lost messages are infinitely late."""
    return lambda cell: percentile([*cell.samples, *[math.inf] * (cell.lost or 0)], percent)


def single(name: str) -> Callable[[Cell], float]:
    """A single value of a cell; NaN without one."""

    def value(cell: Cell) -> float:
        found = cell.figures.get(name)
        return float(found) if isinstance(found, (int, float)) else math.nan

    return value


def outcome(met: bool, *, judged: bool = True) -> str:
    return NOT_JUDGED if not judged else MET if met else MISSED


@dataclass(frozen=True, slots=True, kw_only=True)
class Aim:
    """A bound for a value of some cells, each of which is judged; with ``worst`` only the worst one.

    ``what`` may name the cell's ``{variant}``, its ``{measure}``, its parameters, and the ``{bound}``.
    """

    what: str
    of: Callable[[Cell], bool]
    value: Callable[[Cell], float]
    at_most: float | None = None
    at_least: float | None = None
    unit: str = ""
    worst: bool = False
    least: int = 1  # samples or lost messages, to be judged
    least_rounds: int = 1
    never: str = "not at all"  # in place of an infinite value
    shown: Callable[[float], str] = figure
    beside: Callable[[Cell], str] = lambda _cell: ""  # more that was measured, after the value

    def __call__(self, cells: Sequence[Cell]) -> Iterator[Judged]:
        found = [cell for cell in cells if self.of(cell)]
        if self.worst and found:
            found = [max(found, key=self._beyond)]
        yield from map(self._judged, found)

    def _beyond(self, cell: Cell) -> float:
        value = self.value(cell)
        return self.at_least - value if self.at_least is not None else value - (self.at_most or 0.0)

    def _judged(self, cell: Cell) -> Judged:
        value = self.value(cell)
        enough = len(cell.samples) + (cell.lost or 0) >= self.least and len(cell.rounds) >= self.least_rounds
        bound = self.at_most if self.at_least is None else self.at_least
        return Judged(
            what=self.what.format(variant=cell.variant, measure=cell.measure, bound=bound, **cell.params),
            outcome=outcome(self._beyond(cell) <= 0, judged=enough),
            measured=f"{self._words(value)}{self.beside(cell)}",
        )

    def _words(self, value: float) -> str:
        if math.isfinite(value):
            return f"{self.shown(value)} {self.unit}".strip()
        return "nothing arrived" if math.isnan(value) else self.never
