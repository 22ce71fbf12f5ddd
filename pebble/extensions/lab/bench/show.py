"""The output of a comparison: tables on the terminal, notes, and files."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Final

from rich import box
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table

from pebble.extensions.lab.bench.results import Cell, Results
from pebble.extensions.lab.bench.rounds import LEAST_ROUNDS, ratio

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RATIOS: Final = (
    f"Ratio: median of the rounds, from {LEAST_ROUNDS} rounds on with its interval of 99 %; one that includes 1.00"
    " shows no difference."
)
_WIDEST: Final = 200  # characters of a table


@dataclass(frozen=True, slots=True)
class Picture:
    """A chart: its file name without ending, its caption, and the function that draws it."""

    name: str
    caption: str
    make: Callable[[], Figure]


@dataclass(frozen=True, slots=True)
class Shown:
    """Results with their tables and charts."""

    results: Results
    tables: Sequence[Table]
    pictures: Sequence[Picture] = field(default=())


def finish(shown: Shown, folder: Path, console: Console) -> int:
    """Print and write everything; return 0 if results are complete. Raises PebbleError if a file cannot be written."""
    results = shown.results
    results.save(file := folder / f"{results.bench}.json")  # before anything that may fail
    for table in shown.tables:
        _print_whole(table, console)
    for note in results.notes:
        console.print(note, highlight=False, markup=False, soft_wrap=True)
    files = [file]
    if find_spec("matplotlib") is None:
        console.print("No plots: pip install 'pebble-robot[bench]'", style="dim", highlight=False, markup=False)
    else:
        from pebble.extensions.lab.bench.plots import save

        files += [save(picture, folder, quick=results.quick) for picture in shown.pictures]
    console.print(f"Written: {', '.join(map(str, files))}", style="dim", highlight=False, soft_wrap=True)
    return int(not results.complete)


def _print_whole(table: Table, console: Console) -> None:
    """Print a table; a narrow terminal breaks its lines, but no figure is cut off."""
    width = console.width
    console.width = max(width, Measurement.get(console, console.options.update(max_width=_WIDEST), table).maximum)
    console.print(table)
    console.width = width


def plain_table(title: str, columns: Sequence[str], *, left: int = 1, caption: str = "") -> Table:
    """Return a table in the style of all tables; the first ``left`` columns hold text."""
    table = Table(title=title, title_justify="left", caption=caption, caption_justify="left", box=box.SIMPLE_HEAD,
                  padding=(0, 1, 0, 0))  # fmt: skip
    for number, name in enumerate(columns):
        table.add_column(name, justify="left" if number < left else "right", no_wrap=True)
    return table


def digits(value: float) -> str:
    """Return three significant digits; a dash for NaN, "never" for infinity."""
    if not math.isfinite(value):
        return "–" if math.isnan(value) else "never"
    rounded = abs(float(f"{value:.3g}"))  # 99.96 is shown as 100, not as 100.0
    places = 0 if rounded >= 100 else 1 if rounded >= 10 else 2
    return f"{value:.{places}f}"


def middle(cell: Cell | None) -> str:
    """Return the median of the rounds' medians as text; a dash if nothing was measured."""
    medians = cell.medians() if cell else []
    return digits(median(medians)) if medians else "–"


def spread(cell: Cell | None) -> str:
    """Return ``0.34 (0.31 to 0.39)``: the median, the smallest and the largest of the rounds' medians."""
    medians = cell.medians() if cell else []
    ends = f" ({digits(min(medians))} to {digits(max(medians))})" if len(medians) > 1 else ""
    return f"{middle(cell)}{ends}"


def compared(ours: Cell | None, base: Cell | None, percent: float = 50) -> str:
    """Return the percentiles' ratio as text; empty if ``ours`` is the baseline ``base`` itself, or one is missing."""
    if ours is None or base is None or ours is base:
        return ""
    return str(ratio(ours, base, percent))


def percentiles(cell: Cell, *percents: float) -> list[str]:
    return [digits(cell.percentile(percent)) for percent in percents]
