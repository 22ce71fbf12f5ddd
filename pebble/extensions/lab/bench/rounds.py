"""Runs comparisons in rounds, in which all variants take turns, and computes confidence intervals of ratios.

Samples of one round are not independent: they share processes, a memory layout and a moment of the machine. So each
round counts as one observation, and the variation is estimated by resampling the rounds (decision 0010).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from statistics import NormalDist, fmean
from typing import Final, TypeVar

import msgspec
from rich.console import Console
from rich.markup import escape
from rich.status import Status

from pebble.errors import PebbleError
from pebble.extensions.lab.bench.results import Cell, Results, grouped, percentile

LEVEL: Final = 0.99
LEAST_ROUNDS: Final = 8  # fewer do not support an interval of this level: it is computed, but means little
RESAMPLES = 20_000
_GIVEN_UP = 2  # rounds that fail before any has succeeded: then the run ends
_INFINITE = 1e15  # stands for infinity where resampling computes differences
_LARGEST = 1e6  # ratio that is written as a number

Samples = Sequence[Sequence[float]]  # of each round
Progress = Callable[[str], None]  # shows what is being done
T = TypeVar("T")


# -- turns


def in_turn(things: Sequence[T], number: int) -> Sequence[T]:
    """Return the things in the order for this round: every other round goes backwards."""
    return things[::-1] if number % 2 else things


def measure_rounds(
    results: Results, rounds: int, measure: Callable[[int, Progress], Iterable[Cell]], console: Console
) -> None:
    """Measure all rounds and add their cells to ``results``; a failed round is left out for all variants, and noted.

    Raises PebbleError if the first ones fail, since all would.
    """
    began, failed = time.monotonic(), list[str]()
    with console.status("", refresh_per_second=4) as status:
        for number in range(rounds):
            title = f"round {number + 1} of {rounds}"
            try:
                add_round(results, measure(number, partial(_show_progress, status, title)))
            except (PebbleError, OSError) as error:
                failed.append(f"round {number + 1}: {error}")
                none_succeeded = len(failed) == number + 1
                if none_succeeded and len(failed) == min(_GIVEN_UP, rounds):
                    raise
                console.print(failed[-1], style="red", highlight=False, markup=False)
    results.took_s = round(time.monotonic() - began, 1)
    if failed:
        results.notes.append(f"{len(failed)} of {rounds} rounds failed and were left out; {failed[0].splitlines()[0]}")
    enough = rounds - len(failed) >= LEAST_ROUNDS or rounds < LEAST_ROUNDS  # a shorter run promises no interval
    results.complete = enough and all(cell.samples for cell in results.cells)


def _show_progress(status: Status, title: str, what: str) -> None:
    status.update(escape(f"{title}: {what}"))


def add_round(results: Results, measured: Iterable[Cell]) -> None:
    """Add the cells of a round to those of earlier rounds. Cells of one variant, measure and condition become one.

    Of such cells, figures that are whole numbers are counts, which are added up; other figures are averaged.
    """
    by_key = {_key(cell): cell for cell in results.cells}
    for key, parts in grouped(list(measured), _key).items():
        cell = by_key.get(key)
        if cell is None:
            cell = msgspec.structs.replace(parts[0], rounds=[], figures={})
            results.cells.append(cell)
        cell.rounds.append([sample for part in parts for sample in part.samples])
        for name in parts[0].figures:
            values = [value for part in parts for value in part.figures[name]]
            are_counts = all(isinstance(value, int) for value in values)
            cell.figures.setdefault(name, []).append(sum(values) if are_counts else fmean(values))


def _key(cell: Cell) -> tuple[str, str, frozenset[object]]:
    return cell.variant, cell.measure, frozenset(cell.params.items())


# -- ratios


@dataclass(frozen=True, slots=True)
class Interval:
    """A ratio with its 99 % interval, which needs more than a few rounds; NaN: nothing was measured."""

    ratio: float = math.nan
    low: float = math.nan
    high: float = math.nan
    rounds: int = 0

    def __str__(self) -> str:
        interval = "" if self.rounds < LEAST_ROUNDS else f" ({_digits(self.low)} to {_digits(self.high)})"
        return "–" if math.isnan(self.ratio) else f"{_digits(self.ratio)}{interval}"


def ratio(ours: Cell, theirs: Cell, percent: float = 50) -> Interval:
    """Return the ratio of the percentiles of two cells, measured in turns; lost messages are infinitely late."""
    return paired(ours.with_lost(), theirs.with_lost(), percent)


def paired(ours: Samples, theirs: Samples, percent: float = 50) -> Interval:
    """Return the median over the rounds of our percentile divided by theirs.

    Rounds in which both are infinite are left out. For the interval, rounds are drawn with replacement, as many as
    there are, many times: its ends are quantiles of the medians of these draws, moved outwards by Student's t because
    there are few rounds.
    """
    ratios = []
    for our_samples, their_samples in zip(ours, theirs, strict=False):
        our_value, their_value = percentile(our_samples, percent), percentile(their_samples, percent)
        if their_value > 0 and min(our_value, their_value) < math.inf:  # false for NaN: a round without samples
            ratios.append(min(our_value, _INFINITE) / min(their_value, _INFINITE))  # inf - inf below would be NaN
    if not ratios:
        return Interval()
    import numpy as np  # importing it earlier than it is needed would change the memory of measured processes

    logs = [math.log(ratio) if ratio else -math.inf for ratio in ratios]
    middle = float(np.median(logs))
    random = np.random.default_rng(1)  # the same samples give the same interval
    drawn = np.median(random.choice(logs, (RESAMPLES, len(logs))), axis=1)
    tail, widening = (1 - LEVEL) / 2, _student(len(logs)) / _student(math.inf)
    low, high = (middle + widening * (end - middle) for end in np.quantile(drawn, [tail, 1 - tail]))
    return Interval(math.exp(middle), math.exp(low), math.exp(high), len(logs))


def _student(rounds: float) -> float:
    """Return half of an interval's width in standard errors: Student's t, approximated."""
    z, freedom = NormalDist().inv_cdf((1 + LEVEL) / 2), max(1, rounds - 1)
    return z * (1 + (z**2 + 1) / (4 * freedom) + (5 * z**4 + 16 * z**2 + 3) / (96 * freedom**2))


def _digits(value: float) -> str:
    if value >= _LARGEST:
        return "∞"
    return f"{value:.2f}" if value >= 0.1 else f"{value:.2g}" if value > 1 / _LARGEST else "0"
