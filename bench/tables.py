"""Tables of latencies: one row per cell, with its ratio to a baseline."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rich import box
from rich.table import Table

from pebble.bench.ratios import paired
from pebble.bench.results import Cell

_PERCENTS = (50, 95, 99, 100)


def plain_table(title: str, columns: Sequence[str], *, left: int = 1) -> Table:
    """A table in the style of all tables; the first ``left`` columns hold text."""
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for number, name in enumerate(columns):
        table.add_column(name, justify="left" if number < left else "right", no_wrap=True)
    return table


def latency_table(title: str, cells: Sequence[Cell], baseline: str) -> Table:
    """Rows in the order of the cells. Last column: ratio of the median to ``baseline``'s under the same conditions."""
    unit = cells[0].unit if cells else "us"
    heads = [f"p50 {unit}", "p95", "p99", "max", "n", "lost", f"p50 / {baseline}"]
    table = plain_table(title, ["conditions", "variant", *heads], left=2)
    before = None
    for cell in cells:
        conditions = f"{cell.measure}, {cell.conditions()}"
        base = base_of(cell, cells, baseline)
        ratio = "" if base is None or base is cell else str(paired(cell.rounds, base.rounds))
        lost = "" if cell.lost is None else str(cell.lost)
        times = [figure(cell.percentile(percent)) for percent in _PERCENTS]
        shown = "" if conditions == before else conditions
        if shown and before is not None:
            table.add_section()
        table.add_row(shown, cell.variant, *times, str(len(cell.samples)), lost, ratio)
        before = conditions
    return table


def base_of(cell: Cell, cells: Sequence[Cell], baseline: str) -> Cell | None:
    """The baseline's cell under the same conditions."""
    return next(
        (
            other
            for other in cells
            if other.variant == baseline and other.params == cell.params and other.measure == cell.measure
        ),
        None,
    )


def figure(value: float) -> str:
    """Three significant digits, a dash for NaN."""
    if math.isnan(value):
        return "–"
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.1f}" if abs(value) >= 10 else f"{value:.2f}"
