"""Tables and sentences: what a row of each table looks like, and what is claimed of two variants."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from statistics import median

from rich import box
from rich.table import Table

from pebble.bench.ratios import LEAST_ROUNDS, LEVEL, paired
from pebble.bench.results import Cell, grouped, percentile

_LEAST_APART = 5  # rounds: with three, equal robots are disjoint in one run of ten, with five in one of 126


def plain_table(title: str, columns: Sequence[str], *, left: int = 1) -> Table:
    """A table in the style of all tables; the first ``left`` columns hold text."""
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for number, name in enumerate(columns):
        table.add_column(name, justify="left" if number < left else "right", no_wrap=True)
    return table


def latency_table(title: str, cells: Sequence[Cell], baseline: str) -> Table:
    """Rows in the order of the cells. Last column: ratio of the median to ``baseline``'s under the same conditions."""
    first = percentile_column(50, f"p50 {cells[0].unit if cells else 'us'}")
    columns = (first, *map(percentile_column, (95, 99, 100)), COUNT, LOST)
    return next(Grid(title=title, rows=("conditions", "variant"), columns=columns, baseline=baseline)(cells))


def base_of(cell: Cell, cells: Sequence[Cell], baseline: str) -> Cell | None:
    """The baseline's cell under the same conditions; None for a cell of the baseline."""
    same = (one for one in cells if one.variant == baseline and one.case == cell.case)
    return None if cell.variant == baseline else next(same, None)


def figure(value: float) -> str:
    """Three significant digits, a dash for NaN."""
    if math.isnan(value):
        return "–"
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.1f}" if abs(value) >= 10 else f"{value:.2f}"


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
    """Compares one or two robots in one measure, the baseline first; ``quantity`` as in "takes 0.9× the time".

    Without an interval it states whether all rounds of one robot lie below those of the other.
    """
    unit = f" {cells[0].unit}" if cells[0].unit else ""
    values = ", ".join(f"{cell.variant} {spread(cell)}{unit}" for cell in cells)
    if len(cells) < 2:
        return f"{what}: {values}"
    theirs, ours = cells
    if enough(cells):
        words = paired(ours.rounds, theirs.rounds).words(ours.variant, theirs.variant, quantity)
        return f"{what}: {words}; {values}"
    a, b = medians(ours), medians(theirs)
    if min(len(a), len(b)) < _LEAST_APART:
        return f"{what}: {values}"
    less = ours.variant if max(a) < min(b) else theirs.variant if max(b) < min(a) else None
    return f"{what}: {values}: " + (f"{less} takes less {quantity} in every round" if less else "no clear difference")


def against(cells: Sequence[Cell]) -> str:
    """The second robot's value divided by the first's, with an interval if there are enough rounds."""
    return str(paired(cells[1].rounds, cells[0].rounds))


def enough(cells: Sequence[Cell]) -> bool:
    """Whether there are enough rounds for an interval."""
    return all(len(medians(cell)) >= LEAST_ROUNDS for cell in cells)


def caveat(cells: Sequence[Cell]) -> list[str]:
    """A note below sentences without intervals."""
    if enough(cells):
        return []
    few, needs = min(len(medians(cell)) for cell in cells), f"a {100 * LEVEL:.0f} % interval needs {LEAST_ROUNDS}"
    if few < 2:
        return [f"One round is not enough to compare; {needs}."]
    return [f"{few} rounds, and {needs}: these are medians, with minimum and maximum."]


# -- tables and sentences as data


@dataclass(frozen=True, slots=True)
class Column:
    """What a column shows of a row's cell, or with ``measure`` of the row's cell of this measure."""

    head: str
    value: Callable[[Cell], str]
    measure: str | None = None


def percentile_column(percent: float, head: str = "") -> Column:
    return Column(head or ("max" if percent == 100 else f"p{percent:g}"), lambda cell: figure(cell.percentile(percent)))


def single_column(head: str, name: str, how: str = "g") -> Column:
    """A single value of the cell, formatted as ``how``; empty without one."""

    return Column(head, lambda cell: "" if math.isnan(value := cell.single(name)) else format(value, how))


COUNT = Column("n", lambda cell: str(len(cell.samples)))
LOST = Column("lost", lambda cell: "" if cell.lost is None else str(cell.lost))
SPREAD = Column("", lambda cell: spread(cell))


def median_column(head: str, measure: str | None = None, how: Callable[[float], str] = figure) -> Column:
    """The median of the rounds."""
    return Column(head, lambda cell: how(median(medians(cell) or [math.nan])), measure)


@dataclass(frozen=True, slots=True, kw_only=True)
class Grid:
    """A table: a row for each value of the ``rows`` (parameters, ``conditions``, ``measure``, ``unit`` or ``variant``).

    The columns are repeated side by side for each variant, unless it is one of the rows. The last one is with ``ratio``
    that of the second variant to the first, with ``baseline`` that of the row's variant to this one. A row of the name
    ``last`` comes last, in bold. There is one table for all values of ``each`` of these parameters, which the title may
    name.
    """

    title: str
    rows: Sequence[str]
    columns: Sequence[Column]
    heads: Sequence[str] | None = None  # of the rows
    of: Callable[[Cell], bool] = lambda _cell: True
    ratio: bool = False
    baseline: str = ""
    last: str = ""
    caption: str = ""
    each: Sequence[str] = ()

    def __call__(self, cells: Sequence[Cell]) -> Iterator[Table]:
        cells = list(filter(self.of, cells))
        tables = grouped(cells, lambda cell: _fields(cell, self.each)) if self.each else {(): cells}
        for names, some in tables.items():
            yield self._table(self.title.format(**dict(zip(self.each, names, strict=True))), some)

    def _table(self, title: str, cells: Sequence[Cell]) -> Table:
        variants = list(dict.fromkeys(cell.variant for cell in cells)) if "variant" not in self.rows else [None]
        groups = grouped(cells, lambda cell: _fields(cell, self.rows))
        named = variants if len(variants) > 1 or self.ratio else [None]
        heads = [" ".join(filter(None, (one, column.head))) for one in named for column in self.columns]
        if ratio := self.ratio and len(variants) > 1:
            heads.append(f"{variants[1]} / {variants[0]}")
        elif self.baseline:
            heads.append(f"p50 / {self.baseline}")
        table = plain_table(title, [*(self.heads or self.rows), *heads], left=len(self.rows))
        before = 1
        for first, rows in grouped(groups, lambda row: row[0]).items():
            if max(before, before := len(rows)) > 1:
                table.add_section()
            for row in sorted(rows, key=self._is_last):
                shown = [self._value(groups[row], one, column) for one in variants for column in self.columns]
                base = base_of(groups[row][0], cells, self.baseline)
                shown += [against(groups[row])] if ratio else [against((base, groups[row][0]))] if base else []
                style = "bold" if self._is_last(row) else None
                table.add_row(first, *row[1:], *shown, style=style)
                first = ""
        table.caption, table.caption_justify = self.caption or None, "left"
        return table

    def _is_last(self, row: Sequence[str]) -> bool:
        return bool(self.last) and self.last in row

    def _value(self, group: Sequence[Cell], variant: str | None, column: Column) -> str:
        found = [one for one in group if variant in (None, one.variant) and column.measure in (None, one.measure)]
        return column.value(found[0]) if found else ""


def _fields(cell: Cell, names: Sequence[str]) -> tuple[str, ...]:
    conditions = f"{cell.measure}, {cell.conditions()}"
    own = {"conditions": conditions, "measure": cell.measure, "unit": cell.unit, "variant": cell.variant}
    return tuple(str(own[name] if name in own else cell.params.get(name, "")) for name in names)


@dataclass(frozen=True, slots=True, kw_only=True)
class Claims:
    """A sentence for each measure and condition: the variants, the second one as a ratio to the first.

    ``what`` may name the ``{measure}`` and parameters; ``quantity`` as in "takes 0.9× the time", by measure.
    """

    what: str = "{measure}"
    of: Callable[[Cell], bool] = lambda _cell: True
    quantity: Mapping[str, str] = field(default_factory=dict)
    order: Sequence[str] = ()  # of the variants; else as they were measured
    judged: Callable[[Cell], bool] = lambda _cell: True  # the cells whose number of rounds is noted if it is too small

    def __call__(self, cells: Sequence[Cell]) -> Iterator[str]:
        for group in grouped(filter(self.of, cells), lambda cell: cell.case).values():
            quantity = self.quantity.get(group[0].measure, "time")
            group.sort(key=lambda cell: self.order.index(cell.variant) if self.order else 0)
            what = self.what.format(measure=group[0].measure, quantity=quantity, **group[0].params)
            yield sentence(what, group, quantity=quantity)
        yield from caveat([cell for cell in cells if self.judged(cell)])
