"""Pictures of latencies: their distributions, and each variant's median relative to the baseline's."""

from __future__ import annotations

import math
from collections.abc import Sequence

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
from pebble.bench.results import Cell, Results
from pebble.bench.tables import base_of

LEAST = 20  # samples for a distribution
_POINTS = 400  # of a curve
#: Tick labels of a ratio axis, by the largest ratio of its ends.
_RATIOS = {
    2.2: (0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.3, 1.5),
    12.0: (0.1, 0.2, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 3.0, 5.0),
    math.inf: (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0),
}
_BAR = 0.8
_ITSELF = "itself"
_WHOLE = "all the way"  # drawn after its parts


def distributions(results: Results, title: str, measures: Sequence[str] = ()) -> list[Picture]:
    """One picture per measure, or for each of ``measures``: the share of messages within a time, by condition."""
    found = []
    for measure, cells in by_measure(results.cells, least=LEAST).items():
        if measures and measure not in measures:
            continue
        about = title if measure in title.lower() else f"{title}: {measure}"
        caption = f"{about}. Share of all messages within the time on the x-axis"
        if any(_lost_count(cell) for cell in cells):
            caption += "; lost messages are missing from 100 %"
        make = lambda cells=cells, about=about: _curves(cells, about)  # noqa: E731
        found.append(Picture(file_name(results.bench, measure), caption, make))
    return found


def ratios(results: Results, title: str, baseline: str, measures: Sequence[str] = ()) -> list[Picture]:
    """The medians as ratios to the baseline's; no picture without a baseline."""
    found = []
    for cell in results.cells:
        base = base_of(cell, results.cells, baseline)
        if base is not None and base is not cell and (not measures or cell.measure in measures):
            found.append((cell, paired(cell.rounds, base.rounds)))
    return _picture(results, found, f"{title}: median latency as a ratio to {baseline}'s", baseline)


def null_ratios(results: Results, title: str) -> list[Picture]:
    """The ratios of a null test: a variant against itself, and against itself slowed by a fifth."""
    return _picture(
        results, null.intervals(results.cells), f"{title}: 1.00 is no difference, 1.20 was planted", _ITSELF
    )


def by_measure(cells: Sequence[Cell], least: int = 1) -> dict[str, list[Cell]]:
    found: dict[str, list[Cell]] = {}
    for cell in cells:
        if len(finite(cell.samples)) >= least:
            found.setdefault(cell.measure, []).append(cell)
    return found


def _curves(cells: Sequence[Cell], title: str) -> Figure:
    conditions = sorted(unique([place(cell) for cell in cells]), key=lambda name: name == _WHOLE)
    figure, every = panels(len(conditions), 3, (3.9, 2.7), title)
    style_of = styles(unique([cell.variant for cell in cells]))
    ends = _ends(cells)
    for number, (axes, condition) in enumerate(zip(every, conditions, strict=True)):
        for cell in cells:
            if place(cell) == condition:
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
    positive = [np.array([sample for sample in finite(cell.samples) if sample > 0]) for cell in cells]
    lows = [float(np.quantile(one, 0.001)) for one in positive if len(one)]
    highs = [float(np.quantile(one, 0.998)) for one in positive if len(one)]
    return (0.8 * min(lows), 1.4 * max(highs)) if lows else (0.1, 10.0)


def _picture(results: Results, found: Sequence[tuple[Cell, Interval]], caption: str, baseline: str) -> list[Picture]:
    found = [(cell, interval) for cell, interval in found if math.isfinite(interval.ratio)]
    if not found:
        return []
    few = [interval.few for _, interval in found]
    if all(few):
        caption += f"; no intervals: these need {LEAST_ROUNDS} rounds"
    else:
        caption += "; lines: intervals of 99 %" + (f", none for fewer than {LEAST_ROUNDS} rounds" if any(few) else "")
    return [Picture(f"{results.bench}-ratios", caption, lambda: _bars(found, caption, baseline))]


def _bars(found: Sequence[tuple[Cell, Interval]], title: str, baseline: str) -> Figure:
    measures = unique([cell.measure for cell, _ in found])
    variants = unique([cell.variant for cell, _ in found])
    groups = unique([place(cell) for cell, _ in found])
    height = 0.9 + len(groups) * (0.22 + 0.2 * len(variants))
    figure, every = panels(len(measures), 2, (5.6, max(1.9, height)), title)
    style_of = styles(
        unique([*map(null.variant_of, variants), *variants])
    )  # a role has the same colour with and without the plain one
    style_of = {name: style_of[name] for name in variants}
    low = min(min(_ends_of(interval)) for _, interval in found)
    high = max(max(_ends_of(interval)) for _, interval in found)
    for number, (axes, measure) in enumerate(zip(every, measures, strict=True)):
        for cell, interval in found:
            if cell.measure == measure:
                at = groups.index(place(cell)) + _BAR * ((variants.index(cell.variant) + 0.5) / len(variants) - 0.5)
                _bar(axes, at, _BAR / len(variants), interval, style_of[cell.variant])
        axes.set_yticks(
            range(len(groups)), [short(group) for group in groups] if number % 2 == 0 else [""] * len(groups)
        )
        axes.set_ylim(len(groups) - 0.5, -0.5)
        _ratio_axis(axes, low, high)
        if baseline == _ITSELF:
            axes.axvline(1 + null.SLOWDOWN, color="#222", linewidth=0.9, linestyle="--")
        axes.set_xlabel(f"median as a ratio to {baseline} (log); left of 1 is faster")
        axes.set_title(measure, loc="left")
    legend(figure, {name: Style(style.colour, "", "s") for name, style in style_of.items()}, lines=False)
    return figure


def _bar(axes: Axes, at: float, height: float, interval: Interval, style: Style) -> None:
    axes.barh(at, interval.ratio - 1, left=1, height=0.86 * height, color=style.colour, alpha=0.55)
    axes.plot(_ends_of(interval), [at, at], color="#222", linewidth=1.1, solid_capstyle="butt")
    axes.plot(interval.ratio, at, marker="|", color="#222", markersize=6, markeredgewidth=1.4)


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
    axes.axvline(1.0, color="#222", linewidth=0.9)
