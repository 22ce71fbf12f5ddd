"""Compares two runs of a comparison: did any metric get worse beyond random variation?

Many metrics mean many chances of a false alarm: the confidence level of each grows with their number, so that two runs
of the same program have a chance of about :data:`CHANCE` to show any change at all.
"""

from __future__ import annotations

import math
import statistics
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from rich.console import Console

from pebble.bench.judging.ratios import LEAST_ROUNDS, LEVEL, Interval, student, unpaired
from pebble.bench.results import OVER_TIME, Cell, Results, load, percentile
from pebble.bench.tables import figure, plain_table
from pebble.errors import PebbleError

CHANCE = 0.01
#: Memory layout and core placement of new processes shift medians by this factor between runs, which no number of
#: rounds within one run shows.
THRESHOLD = 1.05
_SAME_EVERY_TIME = ("wire",)  # measures: encoder output is deterministic, one value is exact
_MORE_IS_BETTER = ("1/s",)
_LEAST_SAMPLES = 100  # of a round: with fewer, p99 is the maximum
_LOSS = 0.005  # share of what was sent: smaller changes are ignored


class Kind(StrEnum):
    """The outcome for one metric, in the order of the table."""

    NO_SAMPLES = "nothing in B"  # measured, but without samples, or at a rate of 0
    WORSE = "worse"
    ONLY_A = "only in A"
    ONLY_B = "only in B"
    BETTER = "better"
    UNKNOWN = "unknown"
    EQUAL = "no difference"  # beyond noise


_COLOURS = dict(zip(Kind, ("red", "red", "yellow", "yellow", "green"), strict=False))


@dataclass(frozen=True, slots=True)
class Finding:
    """A percentile of one cell in both runs, as the median over its rounds; NaN: not measured."""

    cell: Cell
    percent: int | None  # None: not a percentile, but the share that was lost, in %
    kind: Kind
    a: float
    b: float
    ratio: Interval  # b / a

    @property
    def changed(self) -> bool:
        return self.kind not in (Kind.EQUAL, Kind.UNKNOWN)


def compare(a: Results, b: Results, threshold: float = THRESHOLD) -> list[Finding]:
    """All findings, the worst first. Each metric that both runs have is judged at the level of :func:`certainty`."""
    before, after = (
        {(cell.variant, cell.case): cell for cell in one.cells if not cell.measure.endswith(OVER_TIME)}
        for one in (a, b)
    )
    both = [(one, after[key]) for key, one in before.items() if key in after and one.samples and after[key].samples]
    asked = [(one, other, percent) for one, other in both for percent in _percents(one, other)]
    findings = [_judged(*one, certainty(len(asked)), threshold) for one in asked]
    for key, cell in {**before, **after}.items():
        old, new = (_figure(cells.get(key), 50) for cells in (before, after))
        if math.isnan(old) != math.isnan(new):
            kind = Kind.ONLY_B if math.isnan(old) else Kind.NO_SAMPLES if key in after else Kind.ONLY_A
            findings.append(Finding(cell, 50, kind, old, new, Interval()))
    return sorted(findings, key=lambda one: (list(Kind).index(one.kind), -one.ratio.ratio if one.ratio.known else 0.0))


def certainty(figures: int) -> float:
    """The confidence level of each of so many intervals."""
    return 1 - CHANCE / max(1, figures)


def differences(a: Results, b: Results) -> list[str]:
    """Other differences between two runs, one line each: the program may then not be the only cause."""
    one, other = ({**run.machine, **run.options, "pebble": run.pebble, "quick": run.quick} for run in (a, b))
    changed = [name for name in {**one, **other} if one.get(name) != other.get(name)]
    return [f"{name}: {one.get(name)} in A, {other.get(name)} in B" for name in changed]


def _percents(one: Cell, other: Cell) -> Iterator[int | None]:
    """Those for which most rounds have enough samples; None: the lost share."""
    yield 50
    if min(statistics.median(filter(None, cell.sizes)) for cell in (one, other)) >= _LEAST_SAMPLES:
        yield 99
    losses = [cell.lost for cell in (one, other) if cell.lost is not None and cell.lost >= 0]
    if len(losses) == 2 and any(losses):
        yield None


def _judged(one: Cell, other: Cell, percent: int | None, level: float, threshold: float) -> Finding:
    if percent is None:
        return _lost(one, other, level)
    ratio, a, b = unpaired(other.rounds, one.rounds, percent, level), _figure(one, percent), _figure(other, percent)
    if other.measure in _SAME_EVERY_TIME:
        ratio = Interval(ratio.ratio, ratio.ratio, ratio.ratio, level)
    if other.unit in _MORE_IS_BETTER and a > 0 and not b:
        kind = Kind.NO_SAMPLES
    elif ratio.few or not ratio.known:  # too few rounds, or values that are 0
        kind = Kind.UNKNOWN
    elif ratio.equal or 1 / threshold < ratio.ratio < threshold:
        kind = Kind.EQUAL
    else:
        kind = Kind.WORSE if (ratio.ratio > 1) != (other.unit in _MORE_IS_BETTER) else Kind.BETTER
    return Finding(other, percent, kind, a, b, ratio)


def _lost(one: Cell, other: Cell, level: float) -> Finding:
    """Judged by the variance between rounds: losses come in bursts. Each round sends equally many."""
    sizes = [(cell.single("sent"), [size for size in cell.sizes if size]) for cell in (one, other)]
    arrived = [[size * len(some) / sent for size in some] for sent, some in sizes]
    rounds, (a, b), kind = min(map(len, arrived)), map(statistics.fmean, arrived), Kind.UNKNOWN
    if rounds >= LEAST_ROUNDS:
        error = math.sqrt(sum(statistics.variance(some) / len(some) for some in arrived))
        changed = abs(b - a) > max(_LOSS, student(level, rounds) * error)
        kind = Kind.EQUAL if not changed else Kind.WORSE if b < a else Kind.BETTER
    return Finding(other, None, kind, 100 * (1 - a), 100 * (1 - b), Interval(level=level, rounds=rounds))


def _figure(cell: Cell | None, percent: int) -> float:
    """The percentile as the median over the rounds, as in the ratio; NaN without samples."""
    rounds = [] if cell is None else [percentile(samples, percent) for samples in cell.rounds if samples]
    return statistics.median(rounds) if rounds else math.nan


def summary(findings: Sequence[Finding], threshold: float = THRESHOLD) -> list[str]:
    """Counts of the outcomes, and what a change is."""
    count = Counter(finding.kind for finding in findings)
    worse, better, equal, unknown = (count[kind] for kind in (Kind.WORSE, Kind.BETTER, Kind.EQUAL, Kind.UNKNOWN))
    level = max((finding.ratio.level for finding in findings), default=LEVEL)
    return [
        f"{worse + better + equal} metrics compared: {worse} worse, {better} better, {equal} without a difference "
        f"beyond noise; {unknown} unknown: fewer than {LEAST_ROUNDS} rounds, or zero",
        f"A change is a factor beyond {threshold:g} whose {100 * level:.4g} % interval excludes 1.00",
    ]


def run(a: Path, b: Path, *, everything: bool = False, console: Console | None = None) -> int:
    """0 if nothing got worse, 1 if something did. Raises PebbleError for files that cannot be compared."""
    console, before, after = console or Console(highlight=False), load(a), load(b)
    if before.bench != after.bench:
        raise PebbleError(f"{a} is of bench {before.bench}, {b} of bench {after.bench}: compare two runs of the same")
    for line in differences(before, after):
        console.print(f"not the same: {line}", style="yellow", markup=False, soft_wrap=True)
    with console.status("comparing"):  # hundreds of intervals take a few seconds
        findings = compare(before, after)
    table = plain_table(f"{before.bench}: B against A", ("what", "metric", "A", "B", "B / A", ""), left=2)
    table.columns[0].no_wrap = False  # long names wrap, so that the outcome is never cut off
    table.columns[-1].justify = "left"
    for one in findings if everything else filter(lambda one: one.changed, findings):
        where = ", ".join(filter(None, (one.cell.variant, one.cell.measure, one.cell.conditions())))
        metric = "lost %" if one.percent is None else f"p{one.percent} {one.cell.unit}"
        figures = (figure(one.a), figure(one.b), str(one.ratio))
        table.add_row(where, metric, *figures, one.kind, style=_COLOURS.get(one.kind))
    if table.row_count:
        console.print(table)
    for line in summary(findings):
        console.print(line, soft_wrap=True)
    return int(any(finding.kind in (Kind.WORSE, Kind.NO_SAMPLES) for finding in findings))
