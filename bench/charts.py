"""Draws the kinds of pictures that :mod:`pebble.bench.pictures` declares: distributions, ratios, dots, bars, tails."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from statistics import median

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from pebble.bench import null
from pebble.bench.plots import (
    Picture,
    Style,
    file_name,
    finite,
    guide,
    legend,
    log_axis,
    panels,
    place,
    short,
    styles,
    unique,
    unit_of,
)
from pebble.bench.ratios import LEAST_ROUNDS, Interval, paired
from pebble.bench.results import Cell, Results, grouped, percentile
from pebble.bench.tables import base_of
from pebble.bench.tables import figure as digits

LEAST = 20  # samples for a distribution
_POINTS = 400  # of a curve
_DARK = "#222"
_BAR = 0.8  # of the distance between groups
_LONGEST = 34  # characters of a label at an axis
_SUM, _WHOLE = "all", "all the way"  # the process that stands for the sum, the hop for all: drawn last
_ITSELF = "itself"
_WORDS = {"wire": "on the wire", "PSS": "memory (PSS)"}
#: Tick labels of a ratio axis, by the largest ratio of its ends.
_RATIOS = {
    2.2: (0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.3, 1.5),
    12.0: (0.1, 0.2, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 3.0, 5.0),
    math.inf: (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0),
}

Ratios = Sequence[tuple[Cell, Interval]]


def distributions(results: Results, title: str, measures: Sequence[str] = ()) -> list[Picture]:
    found = []
    for measure, cells in grouped(_measured(results, LEAST), lambda cell: cell.measure).items():
        if measures and measure not in measures:
            continue
        about = title if measure in title.lower() else f"{title}: {measure}"
        caption = f"{about}. Share of all messages within the time on the x-axis"
        if any(_lost_count(cell) for cell in cells):
            caption += "; lost messages are missing from 100 %"
        found.append(Picture(file_name(results.bench, measure), caption, partial(_curves, cells, about)))
    return found


def ratios(results: Results, title: str, baseline: str, measures: Sequence[str] = ()) -> list[Picture]:
    """No picture without a baseline."""
    found = [
        (cell, paired(cell.rounds, base.rounds))
        for cell in results.cells
        if not measures or cell.measure in measures
        if (base := base_of(cell, results.cells, baseline)) is not None
    ]
    return _ratios(results, found, f"{title}: median latency as a ratio to {baseline}'s", baseline)


def null_ratios(results: Results, title: str) -> list[Picture]:
    found = null.intervals(results.cells)
    return _ratios(results, found, f"{title}: 1.00 is no difference, 1.20 was planted", _ITSELF)


def dots(results: Results, title: str) -> list[Picture]:
    caption = f"{title}: a dot for each launch or late subscriber, a line at the median of the rounds"
    return _picture(results.bench, caption, _measured(results), _dots)


def tails(results: Results, title: str) -> list[Picture]:
    caption = f"{title}: bars to the median, lines to the 99th percentile"
    return _picture(f"{results.bench}-bars", caption, _measured(results), _tails)


def bars(results: Results, title: str, measures: Sequence[str], panel: str, group: str) -> list[Picture]:
    by_measure = grouped(_measured(results), lambda cell: cell.measure)
    found = []
    for measure in measures or by_measure:
        caption = f"{title}: {measure}, medians" if panel else f"{title}: {_measure_text(measure)}"
        make = partial(_panels, panel=panel, group=group) if panel else _amounts
        found += _picture(file_name(results.bench, measure), caption, by_measure.get(measure, []), make)
    return found


def _measured(results: Results, least: int = 1) -> list[Cell]:
    """The cells with so many finite samples."""
    return [cell for cell in results.cells if len(finite(cell.samples)) >= least]


def _picture(
    name: str, caption: str, cells: Sequence[Cell], make: Callable[[Sequence[Cell], str], Figure]
) -> list[Picture]:
    """No picture without cells."""
    return [Picture(name, caption, partial(make, cells, caption))] if cells else []


def _ratios(results: Results, found: Ratios, caption: str, baseline: str) -> list[Picture]:
    found = [(cell, interval) for cell, interval in found if math.isfinite(interval.ratio)]
    if not found:
        return []
    few = [interval.few for _, interval in found]
    if all(few):
        caption += f"; no intervals: these need {LEAST_ROUNDS} rounds"
    else:
        caption += "; lines: intervals of 99 %" + (f", none for fewer than {LEAST_ROUNDS} rounds" if any(few) else "")
    return [Picture(f"{results.bench}-ratios", caption, partial(_ratio_bars, found, caption, baseline))]


# -- distributions


def _curves(cells: Sequence[Cell], title: str) -> Figure:
    by_place = grouped(cells, place)
    conditions = sorted(by_place, key=lambda name: name == _WHOLE)
    figure, every = panels(len(conditions), 3, (3.9, 2.7), title)
    style_of, ends = _styles(cells), _ends(cells)
    for number, (axes, condition) in enumerate(zip(every, conditions, strict=True)):
        for cell in by_place[condition]:
            style = style_of[cell.variant]
            axes.plot(*_curve(cell), color=style.colour, linestyle=style.dash)
        log_axis(axes, "x", f"latency, {unit_of(cells[0].unit)}", *ends)
        axes.set_ylim(0, 101)
        axes.set_title(short(condition, 44), loc="left")
        for percent in (50, 99):
            guide(axes, percent, f"p{percent}")
        if number % 3 == 0:
            axes.set_ylabel("share of messages, %")
    legend(figure, {name: Style(style.colour, style.dash, "") for name, style in style_of.items()})
    return figure


def _curve(cell: Cell) -> tuple[list[float], list[float]]:
    """Points at even steps of the share, finer for the slowest; ends below 100 % by the lost share."""
    ordered = np.sort(finite(cell.samples))
    shares = np.unique(np.concatenate([np.linspace(0, 1, _POINTS), 1 - np.geomspace(1e-4, 0.05, 60)]))
    picked = np.minimum(len(ordered) - 1, (shares * len(ordered)).astype(int))
    arrived = len(ordered) / (len(ordered) + _lost_count(cell))
    return ordered[picked].tolist(), (100 * arrived * shares).tolist()


def _lost_count(cell: Cell) -> int:
    """The number of lost messages, as far as they were counted."""
    return max(0, cell.lost or 0)


def _ends(cells: Sequence[Cell]) -> tuple[float, float]:
    """The ends of the time axis for all panels; cuts off the slowest few."""
    positive = [some for cell in cells if (some := [sample for sample in finite(cell.samples) if sample > 0])]
    lows, highs = ([float(np.quantile(some, share)) for some in positive] for share in (0.001, 0.998))
    return (0.8 * min(lows), 1.4 * max(highs)) if positive else (0.1, 10.0)


# -- ratios


def _ratio_bars(found: Ratios, title: str, baseline: str) -> Figure:
    by_measure = grouped(found, lambda one: one[0].measure)
    variants = unique([cell.variant for cell, _ in found])
    groups = unique([place(cell) for cell, _ in found])
    height = 0.9 + len(groups) * (0.22 + 0.2 * len(variants))
    figure, every = panels(len(by_measure), 2, (5.6, max(1.9, height)), title)
    # a role has the same colour with and without the plain one
    style_of = styles(unique([*map(null.variant_of, variants), *variants]))
    ends = [end for _, interval in found for end in _ends_of(interval)]
    for number, (axes, (measure, some)) in enumerate(zip(every, by_measure.items(), strict=True)):
        for cell, interval in some:
            at = _within(groups.index(place(cell)), variants.index(cell.variant), len(variants))
            height = 0.86 * _BAR / len(variants)
            colour = style_of[cell.variant].colour
            axes.barh(at, interval.ratio - 1, left=1, height=height, color=colour, alpha=0.55)
            axes.plot(_ends_of(interval), [at, at], color=_DARK, linewidth=1.1, solid_capstyle="butt")
            axes.plot(interval.ratio, at, marker="|", color=_DARK, markersize=6, markeredgewidth=1.4)
        axes.set_yticks(range(len(groups)), [short(group) if number % 2 == 0 else "" for group in groups])
        axes.set_ylim(len(groups) - 0.5, -0.5)
        _ratio_axis(axes, min(ends), max(ends))
        if baseline == _ITSELF:
            axes.axvline(1 + null.SLOWDOWN, color=_DARK, linewidth=0.9, linestyle="--")
        axes.set_xlabel(f"median as a ratio to {baseline} (log); left of 1 is faster")
        axes.set_title(measure, loc="left")
    _squares(figure, {name: style_of[name] for name in variants})
    return figure


def _ends_of(interval: Interval) -> tuple[float, float]:
    """The ends of its line; without an interval it has no length."""
    return (interval.ratio, interval.ratio) if interval.few else (interval.low, interval.high)


def _ratio_axis(axes: Axes, low: float, high: float) -> None:
    axes.set_xscale("log")
    low, high = max(0.02, 0.93 * min(low, 0.95)), min(50.0, 1.07 * max(high, 1.25))
    axes.set_xlim(low, high)
    written = next(ratios for span, ratios in _RATIOS.items() if high / low < span)
    axes.xaxis.set_major_locator(FixedLocator([ratio for ratio in written if low <= ratio <= high]))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.axvline(1.0, color=_DARK, linewidth=0.9)


# -- dots


def _dots(cells: Sequence[Cell], title: str) -> Figure:
    kinds = grouped(cells, lambda cell: f"{cell.measure}\n{place(cell)}".strip())
    figure, every = panels(len(kinds), 3, (3.6, 2.9), title)
    style_of = _styles(cells)
    spread = np.random.default_rng(1)
    for axes, (kind, shown) in zip(every, kinds.items(), strict=True):
        for at, cell in enumerate(shown):
            samples, style = finite(cell.samples), style_of[cell.variant]
            beside = spread.uniform(-0.16, 0.16, len(samples))
            axes.scatter(at + beside, samples, s=18, color=style.colour, marker=style.marker, alpha=0.65, linewidths=0)
            middle = median(percentile(finite(one), 50) for one in cell.rounds if finite(one))
            axes.plot([at - 0.3, at + 0.3], [middle, middle], color=_DARK, linewidth=1.5)
            axes.annotate(digits(middle), (at + 0.32, middle), fontsize=8, va="center", annotation_clip=False)
        axes.set_xticks(range(len(shown)), [short(cell.variant, 14) for cell in shown])
        axes.set_xlim(-0.6, len(shown) - 0.2)
        axes.set_ylim(0, 1.08 * max(sample for cell in shown for sample in finite(cell.samples)) or 1.0)
        axes.grid(visible=False, axis="x")
        axes.set_title("\n".join(short(line, 40) for line in kind.split("\n")), loc="left")
        axes.set_ylabel(f"time, {unit_of(shown[0].unit)}")
    return figure


# -- bars


def _panels(cells: Sequence[Cell], title: str, *, panel: str, group: str) -> Figure:
    """A panel for each value of the parameter ``panel``, in which ``group`` names the bars; the sum comes last."""
    panel_of, group_of = (partial(_parameter, name) for name in (panel, group))
    groups = sorted(grouped(cells, group_of), key=lambda name: name == _SUM)
    by_panel, style_of = grouped(cells, panel_of), _styles(cells)
    size = (5.2, 0.9 + 0.17 * len(groups) * len(style_of) + 0.1 * len(groups))
    figure, every = panels(len(by_panel), 2, size, title)
    for axes, (name, some) in zip(every, by_panel.items(), strict=True):
        _grouped(axes, some, groups, group_of, style_of)
        axes.set_xlim(0, 1.14 * max(_p(50, cell) for cell in cells) or 1.0)
        axes.set_title(short(name, 50), loc="left")
        axes.set_xlabel(_axis(cells[0]))
    _squares(figure, style_of)
    return figure


def _parameter(name: str, cell: Cell) -> str:
    return str(cell.params.get(name, ""))


def _amounts(cells: Sequence[Cell], title: str) -> Figure:
    groups, style_of = unique([place(cell) for cell in cells]), _styles(cells)
    figure, (axes,) = panels(1, 1, (8.5, 0.8 + 0.25 * len(groups) + 0.2 * len(cells)), title)
    if len(groups) == 1 or len(style_of) * len(groups) == len(cells):
        _grouped(axes, cells, groups, place, style_of)
        _squares(figure, style_of)
    else:  # most variants have conditions of their own: each bar has its full name as label
        _grouped(axes, cells, unique([_name(cell) for cell in cells]), _name, style_of)
    axes.set_xlabel(_axis(cells[0]))
    return figure


def _name(cell: Cell) -> str:
    return f"{cell.variant}, {place(cell)}".removesuffix(", ")


def _grouped(
    axes: Axes, cells: Sequence[Cell], groups: Sequence[str], group: Callable[[Cell], str], style_of: dict[str, Style]
) -> None:
    """Bars with their values; within a group the variants that exist, without gaps."""
    for at, name in enumerate(groups):
        members = [cell for cell in cells if group(cell) == name]
        if not members:
            axes.annotate(" not running", (0, at), fontsize=8, va="center", color="#777")
        for number, cell in enumerate(members):
            value, y = _p(50, cell), _within(at, number, len(members))
            axes.barh(y, value, height=min(0.5, 0.9 * _BAR / len(members)), color=style_of[cell.variant].colour)
            axes.annotate(f" {digits(value)}", (value, y), fontsize=8, va="center")
    _names(axes, [name or "all" for name in groups])
    axes.set_xlim(0, 1.14 * max((_p(50, cell) for cell in cells), default=0.0) or 1.0)


def _tails(cells: Sequence[Cell], title: str) -> Figure:
    by_place, style_of = grouped(cells, place), _styles(cells)
    variants = list(style_of)
    figure, every = panels(len(by_place), 2, (5.0, 0.9 + 0.32 * len(variants)), title)
    left = 0.5 * min((middle for cell in cells if (middle := _p(50, cell)) > 0), default=1.0)
    for axes, (condition, some) in zip(every, by_place.items(), strict=True):
        log_axis(axes, "x", f"latency, {unit_of(cells[0].unit)}", left, 9 * max(_p(99, cell) for cell in cells))
        for cell in some:
            at, middle, high = variants.index(cell.variant), _p(50, cell), _p(99, cell)
            axes.barh(at, middle - left, left=left, height=0.62, color=style_of[cell.variant].colour, alpha=0.75)
            axes.plot([middle, high], [at, at], color=_DARK, linewidth=1.1)
            axes.plot(high, at, marker="|", color=_DARK, markersize=7, markeredgewidth=1.3)
            axes.annotate(f"  {digits(middle)} / {digits(high)}", (high, at), fontsize=8, va="center")
        _names(axes, variants)
        axes.set_title(short(condition, 50), loc="left")
    return figure


def _names(axes: Axes, names: Sequence[str]) -> None:
    axes.set_yticks(range(len(names)), [short(name, _LONGEST) for name in names])
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.grid(visible=False, axis="y")


def _axis(cell: Cell) -> str:
    unit = "% of one core" if (cell.measure, cell.unit) == ("CPU", "%") else unit_of(cell.unit)
    return ", ".join(filter(None, (_measure_text(cell.measure), unit)))


def _measure_text(measure: str) -> str:
    return _WORDS.get(measure, measure)


# -- common to several


def _p(percent: float, cell: Cell) -> float:
    return percentile(finite(cell.samples), percent)


def _styles(cells: Sequence[Cell]) -> dict[str, Style]:
    return styles(unique([cell.variant for cell in cells]))


def _squares(figure: Figure, style_of: dict[str, Style]) -> None:
    """A legend of colours only."""
    legend(figure, {name: Style(style.colour, "", "s") for name, style in style_of.items()})


def _within(at: float, number: int, count: int) -> float:
    """Where one of ``count`` bars of a group is."""
    return at + _BAR * ((number + 0.5) / count - 0.5)
