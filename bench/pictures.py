"""The kinds of pictures that a comparison may declare: distributions, ratios, dots, bars, tails.

A declared picture is a function of results. matplotlib is imported only when one is drawn.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from pkgutil import resolve_name
from statistics import median
from typing import TYPE_CHECKING, NamedTuple

from pebble.bench import catalogue, null, plots
from pebble.bench.plots import Picture, Style, finite, place, short, unique
from pebble.bench.ratios import LEAST_ROUNDS, Interval, paired
from pebble.bench.results import Cell, Results, grouped, percentile
from pebble.bench.tables import base_of
from pebble.bench.tables import figure as digits

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Declared = Callable[[Results], list[Picture]]

LEAST = 20  # samples for a distribution
_DARK = "#222"
_BAR = 0.8  # of the distance between rows
_LONGEST = 34  # characters of a label at an axis
_SUM, _WHOLE = "all", "all the way"  # the process that stands for the sum, the hop for all: drawn last
_ITSELF = "itself"
_GOLDEN = 0.618
_WORDS = {"wire": "on the wire", "PSS": "memory (PSS)"}
#: Tick labels of a ratio axis, by the largest ratio of its ends.
_RATIOS = {
    2.2: (0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.3, 1.5),
    12.0: (0.1, 0.2, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 3.0, 5.0),
    math.inf: (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0),
}


def draw(results: Results, folder: Path) -> list[Path]:
    """Draws the pictures of a comparison; returns the files. Raises PebbleError if they cannot be written."""
    found = {folder / f"{picture.name}.png": picture for picture in pictures(results)}
    for path, picture in found.items():
        plots.save(picture, path, results)
    return list(found)


def pictures(results: Results) -> list[Picture]:
    known = results.bench in catalogue.MODULES
    declared = catalogue.find(results.bench).pictures if known else [ecdf(results.bench.replace("-", " ").capitalize())]
    return [picture for one in declared for picture in one(results)]


# -- what may be declared


@dataclass(frozen=True, slots=True)
class Drawn:
    """A function of results, ``module:function``, whose module is imported when it draws."""

    by: str

    def __call__(self, results: Results) -> list[Picture]:
        found: list[Picture] = resolve_name(self.by)(results)
        return found


def ecdf(title: str, *, measures: Sequence[str] = ()) -> Declared:
    """For each measure the share of messages within a time; one panel for each condition."""

    def found(results: Results) -> list[Picture]:
        made = []
        for measure, cells in _by_measure(results, measures, LEAST).items():
            about = title if measure in title.lower() else f"{title}: {measure}"
            caption = f"{about}. Share of all messages within the time on the x-axis"
            if any(map(_lost, cells)):
                caption += "; lost messages are missing from 100 %"
            made.append(Picture(plots.file_name(results.bench, measure), caption, partial(_curves, cells, about)))
        return made

    return found


def ratios(title: str, baseline: str, *, measures: Sequence[str] = ()) -> Declared:
    """The medians as ratios to the baseline's, with their intervals. No picture without a baseline."""

    def found(results: Results) -> list[Picture]:
        based = ((cell, base_of(cell, results.cells, baseline)) for cell in results.cells)
        judged = [
            (cell, paired(cell.rounds, base.rounds))
            for cell, base in based
            if base is not None and (not measures or cell.measure in measures)
        ]
        return _ratios(results, judged, f"{title}: median latency as a ratio to {baseline}'s", baseline)

    return found


def null_ratios(title: str) -> Declared:
    """The ratios of a null test to the plain role."""
    caption = f"{title}: 1.00 is no difference, 1.20 was planted"
    return lambda results: _ratios(results, null.intervals(results.cells), caption, _ITSELF)


def dots(title: str) -> Declared:
    """A dot for each sample, and a line at the median; one panel for each measure."""
    caption = f"{title}: a dot for each launch or late subscriber, a line at the median of the rounds"
    return lambda results: _picture(results.bench, caption, _measured(results), _dots)


def bars(title: str, *, measures: Sequence[str] = (), panel: str = "", group: str = "") -> Declared:
    """A bar for each median: one picture for each measure, with a panel or a group for each value of a parameter."""

    def found(results: Results) -> list[Picture]:
        make = partial(_amounts, panel=panel, group=group)
        made = []
        for measure, cells in _by_measure(results, measures).items():
            what = f"{measure}, medians" if panel else _WORDS.get(measure, measure)
            made += _picture(plots.file_name(results.bench, measure), f"{title}: {what}", cells, make)
        return made

    return found


def tails(title: str) -> Declared:
    """Bars to the medians, lines to the 99th percentiles; one panel for each condition."""
    caption = f"{title}: bars to the median, lines to the 99th percentile"
    return lambda results: _picture(f"{results.bench}-bars", caption, _measured(results), _tails)


def _measured(results: Results, least: int = 1) -> list[Cell]:
    """The cells with so many finite samples."""
    return [cell for cell in results.cells if len(finite(cell.samples)) >= least]


def _by_measure(results: Results, measures: Sequence[str], least: int = 1) -> dict[str, list[Cell]]:
    """The measured cells of these measures, or of all."""
    found = grouped(_measured(results, least), lambda cell: cell.measure)
    return {measure: found[measure] for measure in measures or found if measure in found}


def _picture(
    name: str, caption: str, cells: Sequence[Cell], make: Callable[[Sequence[Cell], str], Figure]
) -> list[Picture]:
    """No picture without cells."""
    return [Picture(name, caption, partial(make, cells, caption))] if cells else []


def _ratios(results: Results, judged: Sequence[tuple[Cell, Interval]], caption: str, baseline: str) -> list[Picture]:
    judged = [(cell, interval) for cell, interval in judged if math.isfinite(interval.ratio)]
    if not judged:
        return []
    few = [interval.few for _, interval in judged]
    if all(few):
        caption += f"; no intervals: these need {LEAST_ROUNDS} rounds"
    else:
        caption += "; lines: intervals of 99 %" + (f", none for fewer than {LEAST_ROUNDS} rounds" if any(few) else "")
    return [Picture(f"{results.bench}-ratios", caption, partial(_ratio_bars, judged, caption, baseline))]


# -- how they are drawn


def _curves(cells: Sequence[Cell], title: str) -> Figure:
    """The curves end below 100 % by the lost share; the slowest few are cut off."""
    by_place, style_of = grouped(cells, place), _styles(cells)
    conditions = sorted(by_place, key=lambda name: name == _WHOLE)
    figure, every = plots.panels(len(conditions), 3, (3.9, 2.7), title)
    positive = [[sample for sample in finite(cell.samples) if sample > 0] for cell in cells]
    ends = plots.around([percentile(some, percent) for some in positive for percent in (0.1, 99.8)])
    for number, (axes, condition) in enumerate(zip(every, conditions, strict=True)):
        for cell in by_place[condition]:
            times, style, arrived = sorted(finite(cell.samples)), style_of[cell.variant], sum(cell.sizes)
            step = 100 * arrived / (arrived + _lost(cell)) / len(times)
            shares = [step * count for count in range(1, len(times) + 1)]
            axes.plot(times, shares, color=style.colour, linestyle=style.dash)
        plots.log_axis(axes, "x", f"latency, {plots.unit_of(cells[0].unit)}", *ends)
        axes.set_ylim(0, 101)
        axes.set_title(short(condition, 44), loc="left")
        for percent in (50, 99):
            plots.guide(axes, percent, f"p{percent}")
        if number % 3 == 0:
            axes.set_ylabel("share of messages, %")
    plots.legend(figure, {name: Style(style.colour, style.dash, "") for name, style in style_of.items()})
    return figure


def _lost(cell: Cell) -> int:
    """The number of lost messages, as far as they were counted."""
    return max(0, cell.lost or 0)


def _dots(cells: Sequence[Cell], title: str) -> Figure:
    kinds, style_of = grouped(cells, lambda cell: f"{cell.measure}\n{place(cell)}".strip()), _styles(cells)
    figure, every = plots.panels(len(kinds), 3, (3.6, 2.9), title)
    for axes, (kind, shown) in zip(every, kinds.items(), strict=True):
        for at, cell in enumerate(shown):
            samples, style = finite(cell.samples), style_of[cell.variant]
            beside = [at - 0.16 + 0.32 * (_GOLDEN * number % 1) for number in range(len(samples))]  # evenly spread
            axes.scatter(beside, samples, s=18, color=style.colour, marker=style.marker, alpha=0.65, linewidths=0)
            middle = median(percentile(known, 50) for one in cell.rounds if (known := finite(one)))
            axes.plot([at - 0.3, at + 0.3], [middle, middle], color=_DARK, linewidth=1.5)
            axes.annotate(digits(middle), (at + 0.32, middle), fontsize=8, va="center", annotation_clip=False)
        axes.set_xticks(range(len(shown)), [short(cell.variant, 14) for cell in shown])
        axes.set_xlim(-0.6, len(shown) - 0.2)
        axes.set_ylim(0, 1.08 * max(sample for cell in shown for sample in finite(cell.samples)) or 1.0)
        axes.grid(visible=False, axis="x")
        axes.set_title("\n".join(short(line, 40) for line in kind.split("\n")), loc="left")
        axes.set_ylabel(f"time, {plots.unit_of(shown[0].unit)}")
    return figure


class _Bar(NamedTuple):
    """A bar from ``begin`` to ``value`` in a variant's colour, a line over it, and a text at the end."""

    variant: str
    begin: float
    value: float
    line: tuple[float, float] | None = None
    text: str = ""


def _bars(
    axes: Axes, rows: Sequence[str], bars: Sequence[tuple[str, _Bar]], style_of: dict[str, Style], none: str = ""
) -> None:
    """Draws bars in the rows of these names, without gaps in a row, and a text in a row that has ``none``."""
    for at, name in enumerate(rows):
        row = [bar for one, bar in bars if one == name]
        if not row:
            axes.annotate(none, (0, at), fontsize=8, va="center", color="#777")
        for number, bar in enumerate(row):
            y, height = at + _BAR * ((number + 0.5) / len(row) - 0.5), min(0.5, 0.9 * _BAR / len(row))
            colour = style_of[bar.variant].colour
            axes.barh(y, bar.value - bar.begin, left=bar.begin, height=height, color=colour, alpha=0.8)
            if bar.line is not None:
                axes.plot(bar.line, (y, y), color=_DARK, linewidth=1.1, marker="|", markersize=6)
            axes.annotate(bar.text, (bar.line[1] if bar.line else bar.value, y), fontsize=8, va="center")
    axes.set_yticks(range(len(rows)), [short(name or "all", _LONGEST) for name in rows])
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.grid(visible=False, axis="y")


def _ratio_bars(judged: Sequence[tuple[Cell, Interval]], title: str, baseline: str) -> Figure:
    by_measure = grouped(judged, lambda one: one[0].measure)
    variants, places = (unique([of(cell) for cell, _ in judged]) for of in (lambda cell: cell.variant, place))
    height = 0.9 + len(places) * (0.22 + 0.2 * len(variants))
    figure, every = plots.panels(len(by_measure), 2, (5.6, max(1.9, height)), title)
    # a role has the same colour with and without the plain one
    style_of = plots.styles(unique([*map(null.variant_of, variants), *variants]))
    lows, highs = zip(*(_line(interval) for _, interval in judged), strict=True)
    low, high = max(0.02, 0.93 * min(0.95, *lows)), min(50.0, 1.07 * max(1.25, *highs))
    ticks = next(ratios for span, ratios in _RATIOS.items() if high / low < span)
    for number, (axes, (measure, some)) in enumerate(zip(every, by_measure.items(), strict=True)):
        drawn = [(place(cell), _Bar(cell.variant, 1.0, one.ratio, _line(one))) for cell, one in some]
        _bars(axes, places, drawn, style_of)
        plots.log_axis(axes, "x", f"median as a ratio to {baseline} (log); left of 1 is faster", low, high)
        axes.set_xticks([ratio for ratio in ticks if low <= ratio <= high])
        axes.axvline(1.0, color=_DARK, linewidth=0.9)
        if baseline == _ITSELF:
            axes.axvline(1 + null.SLOWDOWN, color=_DARK, linewidth=0.9, linestyle="--")
        axes.tick_params(labelleft=number % 2 == 0)
        axes.set_title(measure, loc="left")
    _squares(figure, {name: style_of[name] for name in variants})
    return figure


def _line(interval: Interval) -> tuple[float, float]:
    """The ends of its line; without an interval it has no length."""
    return (interval.ratio, interval.ratio) if interval.few else (interval.low, interval.high)


def _amounts(cells: Sequence[Cell], title: str, *, panel: str, group: str) -> Figure:
    """A panel for each value of the parameter ``panel``, in which ``group`` names the rows; the sum comes last."""
    style_of, by_panel = _styles(cells), grouped(cells, lambda cell: str(cell.params.get(panel, "")))
    row_of: Callable[[Cell], str] = (lambda cell: str(cell.params.get(group, ""))) if group else place
    # if most variants have conditions of their own, each bar has its full name as label
    if named := not panel and len(grouped(cells, row_of)) not in (1, len(cells) / len(style_of)):
        row_of = _name
    names = sorted(grouped(cells, row_of), key=lambda name: name == _SUM)
    size = (5.2 if panel else 8.5, 0.9 + 0.17 * max(map(len, by_panel.values())) + 0.15 * len(names))
    figure, every = plots.panels(len(by_panel), 2, size, title)
    unit = "% of one core" if (cells[0].measure, cells[0].unit) == ("CPU", "%") else plots.unit_of(cells[0].unit)
    for axes, (panel_name, some) in zip(every, by_panel.items(), strict=True):
        drawn = [(row_of(one), _Bar(one.variant, 0.0, _p(50, one), text=f" {digits(_p(50, one))}")) for one in some]
        _bars(axes, names, drawn, style_of, " not running")
        axes.set_xlim(0, 1.14 * max(_p(50, cell) for cell in cells) or 1.0)
        axes.set_title(short(panel_name, 50), loc="left")
        axes.set_xlabel(", ".join(filter(None, (_WORDS.get(cells[0].measure, cells[0].measure), unit))))
    if not named:
        _squares(figure, style_of)
    return figure


def _name(cell: Cell) -> str:
    return f"{cell.variant}, {place(cell)}".removesuffix(", ")


def _tails(cells: Sequence[Cell], title: str) -> Figure:
    by_place, style_of = grouped(cells, place), _styles(cells)
    figure, every = plots.panels(len(by_place), 2, (5.0, 0.9 + 0.32 * len(style_of)), title)
    left = 0.5 * min((middle for cell in cells if (middle := _p(50, cell)) > 0), default=1.0)
    for axes, (condition, some) in zip(every, by_place.items(), strict=True):
        plots.log_axis(
            axes, "x", f"latency, {plots.unit_of(cells[0].unit)}", left, 9 * max(_p(99, cell) for cell in cells)
        )
        ends = [(cell.variant, _p(50, cell), _p(99, cell)) for cell in some]
        drawn = [(one, _Bar(one, left, p50, (p50, p99), f"  {digits(p50)} / {digits(p99)}")) for one, p50, p99 in ends]
        _bars(axes, list(style_of), drawn, style_of)
        axes.set_title(short(condition, 50), loc="left")
    return figure


def _p(percent: float, cell: Cell) -> float:
    return percentile(finite(cell.samples), percent)


def _styles(cells: Sequence[Cell]) -> dict[str, Style]:
    return plots.styles(unique([cell.variant for cell in cells]))


def _squares(figure: Figure, style_of: dict[str, Style]) -> None:
    """A legend of colours only."""
    plots.legend(figure, {name: Style(style.colour, "", "s") for name, style in style_of.items()})
