"""Aims of a comparison: declared beside it, judged from its cells, stored and reported as what they are. Pure."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from pebble.bench.judging.ratios import LEAST_ROUNDS, paired
from pebble.bench.results import Cell, Judged, percentile
from pebble.bench.tables import base_of, figure

MET, MISSED, NOT_JUDGED = "met", "missed", "not judged"


def with_lost(percent: float) -> Callable[[Cell], float]:
    """A percentile in which lost messages are infinitely late."""
    return lambda cell: percentile([*cell.samples, *[math.inf] * (cell.lost or 0)], percent)


def single(name: str) -> Callable[[Cell], float]:
    return lambda cell: cell.single(name)


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
        for cell in [max(found, key=self._beyond)] if self.worst and found else found:
            value, bound = self.value(cell), self.at_most if self.at_least is None else self.at_least
            words = self.never if math.isinf(value) else f"{self.shown(value)} {self.unit}".strip()
            words = "nothing arrived" if math.isnan(value) else words
            enough = len(cell.samples) + (cell.lost or 0) >= self.least and len(cell.rounds) >= self.least_rounds
            met = outcome(self._beyond(cell) <= 0, judged=enough)
            yield Judged(what=_what(self.what, cell, bound), outcome=met, measured=words + self.beside(cell))

    def _beyond(self, cell: Cell) -> float:
        value = self.value(cell)
        return self.at_least - value if self.at_least is not None else value - (self.at_most or 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class RatioAim:
    """A bound for the ratio of a percentile of some cells to that of the variant ``to`` under the same conditions.

    Met if all of the ratio's interval is within the bound, missed if all is beyond, else not judged. Lost messages are
    infinitely late. ``what`` is as in :class:`Aim`.
    """

    what: str
    of: Callable[[Cell], bool]
    to: str
    at_most: float
    percent: float = 50
    least: int = 1  # samples of each round, to be judged

    def __call__(self, cells: Sequence[Cell]) -> Iterator[Judged]:
        for cell in filter(self.of, cells):
            if (base := base_of(cell, cells, self.to)) is None:
                continue
            ours, theirs = map(rounds_with_lost, (cell, base))
            interval, why = paired(ours, theirs, self.percent), ""
            if interval.few:
                why = f", {interval.rounds} of {LEAST_ROUNDS} rounds"
            elif min(map(len, (*ours, *theirs))) < self.least:
                why = ", too few samples in a round"
            elif interval.low <= self.at_most < interval.high:
                why = ", the interval includes the bound"
            met = outcome(interval.high <= self.at_most, judged=not why)
            yield Judged(what=_what(self.what, cell, self.at_most), outcome=met, measured=f"{interval}{why}")


def _what(words: str, cell: Cell, bound: float | None) -> str:
    return words.format(variant=cell.variant, measure=cell.measure, bound=bound, **cell.params)


def rounds_with_lost(cell: Cell) -> list[list[float]]:
    """The rounds of a cell with its lost messages as infinitely late. Each round sends equally many."""
    if cell.lost is None:
        return cell.rounds
    each = round((len(cell.samples) + cell.lost) / max(1, len(cell.rounds)))
    return [[*one, *[math.inf] * (each - len(one))] for one in cell.rounds]
