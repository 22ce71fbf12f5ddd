"""Compares two runs of a comparison: did any metric get worse beyond random variation?

Many metrics mean many chances of a false alarm: the confidence level of each grows with their number, so that two runs
of the same program have a chance of about :data:`CHANCE` to show any change at all.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from pebble.bench.ratios import LEAST_ROUNDS, Interval, student, unpaired
from pebble.bench.results import OVER_TIME, Cell, Results, load, percentile
from pebble.bench.tables import figure, plain_table
from pebble.errors import PebbleError

CHANCE = 0.01
#: Memory layout and core placement of new processes shift medians by this factor between runs, which no number of
#: rounds within one run shows.
THRESHOLD = 1.05
_SAME_EVERY_TIME = ("kB/s", "kbit/s")  # encoder output is deterministic: one value is exact
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


@dataclass(frozen=True, slots=True)
class Finding:
    """One percentile of one cell in both runs, as the median over its rounds; or the lost share. NaN: not measured."""

    cell: Cell
    percent: int | None  # None: the share that was lost, in %
    a: float
    b: float
    ratio: Interval  # b / a
    kind: Kind

    @property
    def what(self) -> str:
        return "lost %" if self.percent is None else f"p{self.percent} {self.cell.unit}".strip()

    @property
    def worse(self) -> bool:
        return self.kind in (Kind.WORSE, Kind.NO_SAMPLES)

    @property
    def changed(self) -> bool:
        return self.kind not in (Kind.EQUAL, Kind.UNKNOWN)


def compare(a: Results, b: Results, threshold: float = THRESHOLD) -> list[Finding]:
    """All findings, the worst first. Each metric that both runs have is judged at the level of :func:`certainty`."""
    (before, _), (after, silent) = (_by_key(one.cells) for one in (a, b))
    both = [(cell, after[key]) for key, cell in before.items() if key in after]
    asked = [(one, other, percent) for one, other in both for percent in _percents(one, other)]
    level = certainty(len(asked))
    findings = [_judged(one, other, percent, level, threshold) for one, other, percent in asked]
    for key, cell in {**before, **after}.items():
        if key not in after:
            kind = Kind.NO_SAMPLES if key in silent else Kind.ONLY_A
            findings.append(Finding(cell, 50, _figure(cell, 50), math.nan, Interval(), kind))
        elif key not in before:
            findings.append(Finding(cell, 50, math.nan, _figure(cell, 50), Interval(), Kind.ONLY_B))
    return sorted(findings, key=lambda one: (list(Kind).index(one.kind), -one.ratio.ratio if one.ratio.known else 0.0))


def certainty(figures: int) -> float:
    """The confidence level of each of ``figures`` intervals."""
    return 1 - CHANCE / max(1, figures)


def differences(a: Results, b: Results) -> list[str]:
    """Other differences between two runs, one line each: the program may then not be the only cause."""
    about = [{"pebble": one.pebble, "quick": one.quick} for one in (a, b)]
    groups: dict[str, Any] = {"machine ": (a.machine, b.machine), "option ": (a.options, b.options), "": about}
    return [
        f"{what}{name}: {one.get(name)} in A, {other.get(name)} in B"
        for what, (one, other) in groups.items()
        for name in {**one, **other}
        if one.get(name) != other.get(name)
    ]


def _by_key(cells: Sequence[Cell]) -> tuple[dict[Hashable, Cell], dict[Hashable, Cell]]:
    """The cells with samples, and those without."""
    full: dict[Hashable, Cell] = {}
    silent: dict[Hashable, Cell] = {}
    for cell in (cell for cell in cells if not cell.measure.endswith(OVER_TIME)):
        (full if cell.samples else silent)[cell.variant, cell.case] = cell
    return full, silent


def _percents(one: Cell, other: Cell) -> Iterator[int | None]:
    """The percentiles for which most rounds have enough samples; None for the lost share, if one is known."""
    yield 50
    if all(statistics.median(size for size in cell.sizes if size) >= _LEAST_SAMPLES for cell in (one, other)):
        yield 99
    losses = [cell.lost for cell in (one, other) if cell.lost is not None and cell.lost >= 0]
    if len(losses) == 2 and any(losses):
        yield None


def _judged(one: Cell, other: Cell, percent: int | None, level: float, threshold: float) -> Finding:
    if percent is None:
        return _lost(one, other, level)
    ratio = unpaired(other.rounds, one.rounds, percent, level)
    exact = other.unit in _SAME_EVERY_TIME
    if exact:
        ratio = replace(ratio, low=ratio.ratio, high=ratio.ratio)
    a, b = _figure(one, percent), _figure(other, percent)
    if other.unit in _MORE_IS_BETTER and a > 0 and not b:
        kind = Kind.NO_SAMPLES
    elif (ratio.few and not exact) or not ratio.known:  # too few rounds, or values that are 0
        kind = Kind.UNKNOWN
    elif ratio.equal or 1 / threshold < ratio.ratio < threshold:
        kind = Kind.EQUAL
    else:
        kind = Kind.WORSE if (ratio.ratio > 1) != (other.unit in _MORE_IS_BETTER) else Kind.BETTER
    return Finding(other, percent, a, b, ratio, kind)


def _lost(one: Cell, other: Cell, level: float) -> Finding:
    """Compares lost shares by the variance between rounds: losses come in bursts. Each round sends equally many."""
    shares = []
    for cell in (one, other):
        arrived = [size for size in cell.sizes if size]
        each = int(cell.figures["sent"] or 0) / len(arrived)
        shares.append([1 - count / each for count in arrived])
    rounds, (a, b), kind = min(map(len, shares)), map(statistics.fmean, shares), Kind.UNKNOWN
    if rounds >= LEAST_ROUNDS:
        error = math.sqrt(sum(statistics.variance(some) / len(some) for some in shares))
        changed = abs(b - a) > max(_LOSS, student(level, rounds) * error)
        kind = Kind.EQUAL if not changed else Kind.WORSE if b > a else Kind.BETTER
    return Finding(other, None, 100 * a, 100 * b, Interval(level=level, rounds=rounds), kind)


def _figure(cell: Cell, percent: int) -> float:
    """The percentile as the median over the rounds, as in the ratio."""
    return statistics.median(percentile(samples, percent) for samples in cell.rounds if samples)


def summary(findings: Sequence[Finding], threshold: float = THRESHOLD) -> list[str]:
    """Counts of the outcomes and the sensitivity of the comparison, as sentences."""
    count = {kind: sum(finding.kind is kind for finding in findings) for kind in Kind}
    judged = [finding for finding in findings if finding.kind in (Kind.WORSE, Kind.BETTER, Kind.EQUAL)]
    lines = [
        f"{len(judged)} metrics compared: {count[Kind.WORSE]} worse, {count[Kind.BETTER]} better,"
        f" {count[Kind.EQUAL]} without a difference beyond noise"
    ]
    if judged:
        lines.append(
            f"A change is a factor beyond {threshold:g} whose {100 * judged[0].ratio.level:.4g} % interval excludes"
            f" 1.00; random variation within the runs shows any change with a chance of about {100 * CHANCE:g} %, and"
            " variation between runs adds to that"
        )
    if ratios := [one.ratio for one in judged if one.percent == 50]:
        seen = max(threshold, statistics.median(max(one.high / one.ratio, one.ratio / one.low) for one in ratios))
        lines.append(f"Half of the medians would have shown a change by a factor of {seen:.2f}")
    notes = {
        Kind.NO_SAMPLES: "without samples in B: counted as worse",
        Kind.UNKNOWN: f"unknown: fewer than {LEAST_ROUNDS} rounds, or zero",
        Kind.ONLY_A: "only in A: not measured in B",
        Kind.ONLY_B: "only in B",
    }
    return [*lines, *(f"{count[kind]} {note}" for kind, note in notes.items() if count[kind])]


# -- what is printed

_COLOURS = {
    Kind.NO_SAMPLES: "red", Kind.WORSE: "red", Kind.ONLY_A: "yellow", Kind.ONLY_B: "yellow", Kind.BETTER: "green",
}  # fmt: skip


def run(
    a: Path, b: Path, *, threshold: float = THRESHOLD, everything: bool = False, console: Console | None = None
) -> int:
    """0 if nothing got worse, 1 if something did. Raises PebbleError for files that cannot be compared."""
    console = console or Console()
    if not (math.isfinite(threshold) and threshold >= 1):
        raise PebbleError(
            f"--threshold {threshold:g}: a factor of 1 or more is needed (1.05 ignores changes below 5 %)"
        )
    before, after = load(a), load(b)
    if before.bench != after.bench:
        raise PebbleError(
            f"{a} is of bench {before.bench}, {b} of bench {after.bench}: compare two runs of the same bench"
        )
    for line in differences(before, after):
        console.print(f"not the same: {line}", style="yellow", highlight=False, markup=False, soft_wrap=True)
    with console.status("comparing"):  # hundreds of intervals take a few seconds
        findings = compare(before, after, threshold)
    shown = [finding for finding in findings if everything or finding.changed]
    if shown:
        console.print(_table(shown, before.bench))
    for line in summary(findings, threshold):
        console.print(line, highlight=False, soft_wrap=True)
    return int(any(finding.worse for finding in findings))


def _table(findings: Sequence[Finding], bench: str) -> Table:
    table = plain_table(f"{bench}: B against A", ("what", "metric", "A", "B", "B / A", ""), left=2)
    table.columns[0].no_wrap = False  # long names wrap, so that the outcome is never cut off
    for finding in findings:
        cell = finding.cell
        where = ", ".join(filter(None, (cell.variant, cell.measure, cell.conditions())))
        values = (figure(finding.a), figure(finding.b), str(finding.ratio))
        table.add_row(where, finding.what, *values, finding.kind, style=_COLOURS.get(finding.kind))
    table.columns[-1].justify = "left"
    return table
