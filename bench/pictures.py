"""The kinds of pictures that a comparison may declare: distributions, ratios, dots, bars, tails.

A declared picture is a function of results. matplotlib is imported only when one is drawn.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from pkgutil import resolve_name
from statistics import median
from typing import TYPE_CHECKING, cast

from pebble.bench import plots
from pebble.bench.comparison import find
from pebble.bench.judging import null
from pebble.bench.judging.ratios import LEAST_ROUNDS, Interval, paired
from pebble.bench.plots import Picture, Style, finite, short, unique
from pebble.bench.results import Cell, Results, grouped, percentile
from pebble.bench.tables import base_of, medians
from pebble.bench.tables import figure as digits

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Declared = Callable[[Results], Iterable[Picture]]
Make = Callable[[Sequence[Cell], str], "Figure"]  # of cells, under a title
_Judged = Sequence[tuple[Cell, Interval]]

LEAST = 20  # samples for a distribution
_DARK = "#222"
_SUM, _WHOLE = "all", "all the way"  # the process that stands for the sum, the hop for all: drawn last
_ITSELF = "itself"
_GOLDEN = 0.618


def draw(results: Results, folder: Path) -> dict[Path, Picture]:
    """Draws the pictures of a comparison, by file. Raises PebbleError if they cannot be written."""
    found = {folder / f"{picture.name}.png": picture for picture in pictures(results)}
    for path, picture in found.items():
        plots.save(picture, path, results)
    return found


def pictures(results: Results) -> list[Picture]:
    return [picture for one in find(results.bench).report.pictures for picture in one(results)]


@dataclass(frozen=True, slots=True)
class Drawn:
    """A function of results, ``module:function``, whose module is imported when it draws."""

    by: str

    def __call__(self, results: Results) -> Iterable[Picture]:
        return cast(Declared, resolve_name(self.by))(results)


def ecdf(title: str, *, measures: Sequence[str] = ()) -> Declared:
    """The share of messages within a time, for each measure; one panel for each condition."""
    caption = f"{title}: {{measure}}. Share of all messages, lost ones included, within the time"
    return _declared(_curves, caption, measures=measures, least=LEAST)


def bars(title: str, *, measures: Sequence[str] = (), panel: str = "", group: str = "") -> Declared:
    """A bar for each median: one picture for each measure, with a panel or a group for each value of a parameter."""
    make = partial(_amounts, panel=panel, group=group)
    return _declared(make, f"{title}: {{measure}}, medians", measures=measures)


def dots(title: str) -> Declared:
    """A dot for each sample, and a line at the median; one panel for each measure."""
    caption = f"{title}: a dot for each launch or late subscriber, a line at the median of the rounds"
    return _declared(_dots, caption, name="")


def tails(title: str) -> Declared:
    """Bars to the medians, lines to the 99th percentiles; one panel for each condition."""
    return _declared(_tails, f"{title}: bars to the median, lines to the 99th percentile", name="bars")


def growth(title: str, measures: Sequence[str], *, over: str) -> Declared:
    """Lines through the medians of each measure as the parameter ``over`` grows; one panel for each unit."""
    make = partial(_lines, over=over)
    return _declared(make, f"{title}: what it costs, by {over}", measures=measures, name="growth")


def _declared(
    make: Make, caption: str, *, measures: Sequence[str] = (), least: int = 1, name: str | None = None
) -> Declared:
    """A picture for each of these measures, or for all, in a file of its name; or of this name for all together.

    Cells with fewer finite samples than ``least`` are not drawn.
    """

    def found(results: Results) -> Iterator[Picture]:
        cells = (cell for cell in results.cells if cell.measure in (measures or (cell.measure,)))
        known = (cell for cell in cells if len(finite(cell.samples)) >= least)
        for what, some in grouped(known, lambda cell: cell.measure if name is None else name).items():
            file = re.sub("[^a-z0-9]+", "-", f"{results.bench}-{what}".lower()).strip("-")
            yield Picture(file, title := caption.format(measure=what), partial(make, some, title))

    return found


def ratios(title: str, baseline: str, *, measures: Sequence[str] = ()) -> Declared:
    """The medians as ratios to the baseline's, with their intervals. No picture without a baseline."""

    def found(results: Results) -> Iterator[Picture]:
        cells = [cell for cell in results.cells if cell.measure in (measures or (cell.measure,))]
        based = [(cell, base) for cell in cells if (base := base_of(cell, cells, baseline)) is not None]
        judged = [(cell, paired(cell.rounds, base.rounds)) for cell, base in based]
        return _ratios(results, judged, f"{title}: median latency as a ratio to {baseline}'s", baseline)

    return found


def null_ratios(title: str) -> Declared:
    """The ratios of a null test to the plain role."""
    caption = f"{title}: 1.00 is no difference, 1.20 was planted"
    return lambda results: _ratios(results, null.intervals(results.cells), caption, _ITSELF)


def _ratios(results: Results, judged: _Judged, caption: str, baseline: str) -> Iterator[Picture]:
    if judged := [(cell, interval) for cell, interval in judged if math.isfinite(interval.ratio)]:
        few = all(interval.few for _, interval in judged)
        caption += f"; no intervals: these need {LEAST_ROUNDS} rounds" if few else "; lines: intervals of 99 %"
        yield Picture(f"{results.bench}-ratios", caption, partial(_ratio_bars, judged, caption, baseline))


def _curves(cells: Sequence[Cell], title: str) -> Figure:
    """The curves end below 100 % by the lost share; the slowest few are cut off."""
    by_place, style_of = grouped(cells, Cell.conditions), plots.styles([cell.variant for cell in cells])
    figure, every = plots.panels(len(by_place), 3, (3.9, 2.7), title)
    positive = [[sample for sample in finite(cell.samples) if sample > 0] for cell in cells]
    ends = plots.around([percentile(some, percent) for some in positive for percent in (0.1, 99.8)])
    for axes, place in zip(every, sorted(by_place, key=lambda name: name == _WHOLE), strict=True):
        for cell in by_place[place]:
            times, style, arrived = sorted(finite(cell.samples)), style_of[cell.variant], sum(cell.sizes)
            step = 100 * arrived / (arrived + max(0, cell.lost or 0)) / len(times)
            shares = [step * count for count in range(1, len(times) + 1)]
            axes.plot(times, shares, color=style.colour, linestyle=style.dash)
        plots.log_axis(axes, "x", f"latency, {_unit(cells)}", *ends)
        axes.set(ylim=(0, 101), title=short(place, 44))
        for percent in (50, 99):
            plots.guide(axes, percent, f"p{percent}")
    plots.legend(figure, {name: replace(style, marker="") for name, style in style_of.items()})
    return figure


def _dots(cells: Sequence[Cell], title: str) -> Figure:
    kinds = grouped(cells, lambda cell: f"{cell.measure}\n{cell.conditions()}".strip())
    style_of = plots.styles([cell.variant for cell in cells])
    figure, every = plots.panels(len(kinds), 3, (3.6, 2.9), title)
    for axes, (kind, shown) in zip(every, kinds.items(), strict=True):
        for at, cell in enumerate(shown):
            samples, style, middle = finite(cell.samples), style_of[cell.variant], median(medians(cell))
            beside = [at - 0.16 + 0.32 * (_GOLDEN * number % 1) for number in range(len(samples))]  # evenly spread
            axes.scatter(beside, samples, s=18, color=style.colour, marker=style.marker, alpha=0.65, linewidths=0)
            axes.plot([at - 0.3, at + 0.3], [middle, middle], color=_DARK, linewidth=1.5)
            axes.annotate(digits(middle), (at + 0.32, middle), fontsize=8, va="center", annotation_clip=False)
        axes.set_xticks(range(len(shown)), [short(cell.variant, 14) for cell in shown])
        top = 1.08 * max(sample for cell in shown for sample in finite(cell.samples)) or 1.0
        axes.set(xlim=(-0.6, len(shown) - 0.2), ylim=(0, top), title=short(kind, 40), ylabel=f"time, {_unit(shown)}")
        axes.grid(visible=False, axis="x")
    return figure


@dataclass(frozen=True, slots=True)
class _Bar:
    """A bar in a panel and in a row, in a variant's colour; a line over it, and a text at the end of both."""

    panel: str
    row: str
    variant: str
    begin: float
    end: float
    line: tuple[float, ...] = ()
    text: str = ""


def _bar_panels(title: str, bars: Sequence[_Bar], width: float, axis: Callable[[Axes], object], *more: str) -> Figure:
    """Panels of bars, those of a row below each other; the row of the sum comes last. ``more`` have a style, too."""
    rows = sorted(unique([bar.row for bar in bars]), key=lambda row: row == _SUM)
    by_panel, variants = grouped(bars, lambda bar: bar.panel), unique([bar.variant for bar in bars])
    height = 0.9 + 0.17 * max(map(len, by_panel.values())) + 0.15 * len(rows)
    style_of = plots.styles([*more, *variants])
    figure, every = plots.panels(len(by_panel), 2, (width, height), title)
    for axes, (panel, some) in zip(every, by_panel.items(), strict=True):
        for at, row in enumerate(rows):
            here = [bar for bar in some if bar.row == row]
            for number, bar in enumerate(here):
                y, colour = at + 0.8 * ((number + 0.5) / len(here) - 0.5), style_of[bar.variant].colour
                thick = min(0.5, 0.72 / len(here))
                axes.barh(y, bar.end - bar.begin, left=bar.begin, height=thick, color=colour, alpha=0.8)
                axes.plot(bar.line, [y] * len(bar.line), color=_DARK, linewidth=1.1, marker="|", markersize=6)
                axes.annotate(bar.text, (max((bar.end, *bar.line)), y), fontsize=8, va="center")
        axes.set_yticks(range(len(rows)), [short(row or "all", 34) for row in rows])
        axes.set(ylim=(len(rows) - 0.4, -0.6), title=short(panel, 50))
        axes.grid(visible=False, axis="y")
        axis(axes)
    plots.legend(figure, {name: Style(style_of[name].colour, "", "s") for name in variants})
    return figure


def _ratio_bars(judged: _Judged, title: str, baseline: str) -> Figure:
    bars = [
        _Bar(cell.measure, cell.conditions(), cell.variant, 1.0, one.ratio,
             (one.ratio, one.ratio) if one.few else (one.low, one.high))
        for cell, one in judged
    ]  # fmt: skip
    low = max(0.02, 0.93 * min(0.95, *(bar.line[0] for bar in bars)))
    high = min(50.0, 1.07 * max(1.25, *(bar.line[1] for bar in bars)))

    def axis(axes: Axes) -> None:
        plots.log_axis(axes, "x", f"median as a ratio to {baseline} (log); left of 1 is faster", low, high)
        axes.axvline(1.0, color=_DARK, linewidth=0.9)
        if baseline == _ITSELF:
            axes.axvline(1 + null.SLOWDOWN, color=_DARK, linewidth=0.9, linestyle="--")

    # a role has the same colour with and without the plain one
    return _bar_panels(title, bars, 5.6, axis, *(null.variant_of(cell.variant) for cell, _ in judged))


def _amounts(cells: Sequence[Cell], title: str, *, panel: str, group: str) -> Figure:
    """A panel for each value of the parameter ``panel``, in which ``group`` names the rows."""
    bars = []
    for cell, p50 in ((cell, _p(50, cell)) for cell in cells):
        row = str(cell.params[group]) if group else cell.conditions() or cell.variant
        bars.append(_Bar(str(cell.params.get(panel, "")), row, cell.variant, 0.0, p50, text=f" {digits(p50)}"))
    right, label = 1.14 * max(bar.end for bar in bars) or 1.0, f"{cells[0].measure}, {_unit(cells)}"
    return _bar_panels(title, bars, 5.2 if panel else 8.5, lambda axes: axes.set(xlim=(0, right), xlabel=label))


def _lines(cells: Sequence[Cell], title: str, *, over: str) -> Figure:
    by_unit, style_of = grouped(cells, _by_unit), plots.styles(unique([cell.measure for cell in cells]))
    figure, every = plots.panels(len(by_unit), 3, (3.9, 3.0), title)
    for axes, (unit, some) in zip(every, by_unit.items(), strict=True):
        for name, points in grouped(some, lambda cell: cell.measure).items():
            found = sorted((float(cell.params[over]), _p(50, cell)) for cell in points)  # type: ignore[arg-type]
            style = style_of[name]
            axes.plot(*zip(*found, strict=True), color=style.colour, linestyle=style.dash, marker=style.marker)
            axes.annotate(f" {digits(found[-1][1])}", found[-1], fontsize=8, va="center", annotation_clip=False)
        axes.set(xlim=(0, None), ylim=(0, None), xlabel=over, ylabel=unit)
    plots.legend(figure, style_of)
    return figure


def _tails(cells: Sequence[Cell], title: str) -> Figure:
    ends = [(cell, _p(50, cell), _p(99, cell)) for cell in cells]
    left, right = 0.5 * min((p50 for _, p50, _ in ends if p50 > 0), default=1.0), 9 * max(p99 for *_, p99 in ends)
    bars = [
        _Bar(cell.conditions(), cell.variant, cell.variant, left, p50, (p50, p99), f"  {digits(p50)} / {digits(p99)}")
        for cell, p50, p99 in ends
    ]
    label = f"latency, {_unit(cells)}"
    return _bar_panels(title, bars, 5.0, lambda axes: plots.log_axis(axes, "x", label, left, right))


def _p(percent: float, cell: Cell) -> float:
    return percentile(finite(cell.samples), percent)


def _by_unit(cell: Cell) -> str:
    return {"%": "CPU, % of a core", "MB": "memory (PSS), MB"}.get(cell.unit, cell.unit)


def _unit(cells: Sequence[Cell]) -> str:
    return "µs" if cells[0].unit == "us" else cells[0].unit
