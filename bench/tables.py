"""Tables and sentences: what a row of each table looks like, and what is claimed of two variants."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from statistics import median

from rich import box
from rich.table import Table

from pebble.bench.judging.ratios import LEAST_ROUNDS, LEVEL, paired
from pebble.bench.results import Cell, grouped, percentile


def plain_table(title: str, columns: Sequence[str], *, left: int = 1) -> Table:
    """A table in the style of all tables; the first ``left`` columns hold text."""
    table = Table(title=title, title_justify="left", caption_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for number, name in enumerate(columns):
        table.add_column(name, justify="left" if number < left else "right", no_wrap=True)
    return table


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
    """``0.34 (0.31 to 0.39)``: the median of the rounds, and the ends if there are several."""
    rounds = medians(cell)
    ends = f" ({figure(min(rounds))} to {figure(max(rounds))})" if len(rounds) > 1 else ""
    return f"{figure(median(rounds))}{ends}" if rounds else "–"


def sentence(what: str, cells: Sequence[Cell], *, quantity: str) -> str:
    """One or two variants, the baseline first; they are compared if there are enough rounds for an interval."""
    values = ", ".join(f"{cell.variant} {spread(cell)} {cell.unit}".strip() for cell in cells)
    if len(cells) < 2 or caveat(cells):
        return f"{what}: {values}"
    theirs, ours = cells
    words = paired(ours.rounds, theirs.rounds).words(ours.variant, theirs.variant, quantity)
    return f"{what}: {words}; {values}"


def caveat(cells: Sequence[Cell]) -> list[str]:
    """A note below sentences without intervals."""
    few = min((len(medians(cell)) for cell in cells), default=LEAST_ROUNDS)
    rounds = f"{few} round{'s' if few != 1 else ''}, and a {100 * LEVEL:.0f} % interval needs {LEAST_ROUNDS}"
    return [f"{rounds}: these are medians, with minimum and maximum."] if few < LEAST_ROUNDS else []


@dataclass(frozen=True, slots=True)
class Column:
    """What a column shows of a row's cell, or with ``measure`` of the row's cell of this measure."""

    head: str
    value: Callable[[Cell], str]
    measure: str | None = None


def percentile_column(percent: float, head: str = "", measure: str | None = None) -> Column:
    head = head or ("max" if percent == 100 else f"p{percent:g}")
    return Column(head, lambda cell: figure(cell.percentile(percent)), measure)


def single_column(head: str, name: str, how: str = "g") -> Column:
    """A single value of the cell, formatted as ``how``; empty without one."""
    return Column(head, lambda cell: "" if math.isnan(value := cell.single(name)) else format(value, how))


COUNT = Column("n", lambda cell: str(len(cell.samples)))
LOST = Column("lost", lambda cell: "" if cell.lost is None else str(cell.lost))
SPREAD = Column("", spread)


def median_column(head: str, measure: str | None = None, how: Callable[[float], str] = figure) -> Column:
    """The median of the rounds."""
    return Column(head, lambda cell: how(median(medians(cell) or [math.nan])), measure)


@dataclass(frozen=True, slots=True, kw_only=True)
class Grid:
    """A table: a row for each value of the ``rows`` (parameters, ``conditions``, ``measure``, ``unit`` or ``variant``).

    The columns are repeated side by side for each variant, unless it is one of the rows. The last one is with ``ratio``
    that of the second variant to the first, with ``baseline`` that of the row's variant to this one.
    """

    title: str
    rows: Sequence[str]
    columns: Sequence[Column]
    heads: Sequence[str] | None = None  # of the rows
    of: Callable[[Cell], bool] = lambda _cell: True
    ratio: bool = False
    baseline: str = ""
    last: str | None = None  # the row of this name comes last, in bold
    caption: str = ""
    each: Sequence[str] = ()  # a table for all values of each of these parameters, which the title may name

    def __call__(self, cells: Sequence[Cell]) -> Iterator[Table]:
        for names, some in grouped(filter(self.of, cells), lambda cell: _fields(cell, self.each)).items():
            yield self._table(self.title.format(**dict(zip(self.each, names, strict=True))), some)

    def _table(self, title: str, cells: Sequence[Cell]) -> Table:
        variants = [""] if "variant" in self.rows else list(dict.fromkeys(cell.variant for cell in cells))
        named = variants if len(variants) > 1 or self.ratio else [""]
        heads = [f"{one} {column.head}".strip() for one in named for column in self.columns]
        if self.ratio and len(variants) > 1:
            heads.append(f"{variants[1]} / {variants[0]}")
        elif self.baseline:
            heads.append(f"p50 / {self.baseline}")
        table = plain_table(title, [*(self.heads or self.rows), *heads], left=len(self.rows))
        table.caption = self.caption
        groups = grouped(cells, lambda cell: _fields(cell, self.rows))
        blocks = grouped(groups, lambda row: row[0])
        for name, rows in blocks.items():
            if len(groups) > len(blocks):
                table.add_section()
            for number, row in enumerate(sorted(rows, key=lambda row: self.last in row)):
                group = groups[row]
                pair = group if self.ratio else [*filter(None, [base_of(group[0], cells, self.baseline)]), group[0]]
                shown = [self._value(group, one, column) for one in variants for column in self.columns]
                shown += [str(paired(pair[1].rounds, pair[0].rounds))] if len(pair) > 1 else []
                table.add_row("" if number else name, *row[1:], *shown, style="bold" if self.last in row else None)
        return table

    def _value(self, group: Sequence[Cell], variant: str, column: Column) -> str:
        found = (one for one in group if variant in ("", one.variant) and column.measure in (None, one.measure))
        return next(map(column.value, found), "")


def _fields(cell: Cell, names: Sequence[str]) -> tuple[str, ...]:
    conditions = f"{cell.measure}, {cell.conditions()}"
    own = {"conditions": conditions, "measure": cell.measure, "unit": cell.unit, "variant": cell.variant}
    return tuple(str({**cell.params, **own}.get(name, "")) for name in names)


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
            measure, quantity = group[0].measure, self.quantity.get(group[0].measure, "time")
            group.sort(key=lambda cell: self.order.index(cell.variant) if self.order else 0)
            what = self.what.format(measure=measure, quantity=quantity, **group[0].params)
            yield sentence(what, group, quantity=quantity)
        yield from caveat([cell for cell in cells if self.judged(cell)])
