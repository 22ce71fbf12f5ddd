"""Pictures of bars and dots: start-up times, what processes cost, frames, bytes on the wire."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pebble.bench.plots import (
    Picture,
    Style,
    file_name,
    finite,
    legend,
    log_axis,
    panels,
    place,
    short,
    styles,
    unique,
    unit_of,
)
from pebble.bench.results import Cell, Results, percentile
from pebble.bench.tables import figure as digits

_BAR = 0.8
_SUM = "all"  # the process that stands for the sum
_WORDS = {"wire": "on the wire", "PSS": "memory (PSS)"}
_LONGEST = 34  # characters of a label at an axis


def dots(results: Results, title: str) -> list[Picture]:
    """One dot per launch, and the median."""
    caption = f"{title}: a dot for each launch or late subscriber, a line at the median of the rounds"
    return _picture(results.bench, caption, _measured(results), _dots)


def tails(results: Results, title: str) -> list[Picture]:
    """Medians as bars, with a line to the 99th percentile; one panel per condition."""
    caption = f"{title}: bars to the median, lines to the 99th percentile"
    return _picture(f"{results.bench}-bars", caption, _measured(results), _tails)


def bars(results: Results, title: str, measures: Sequence[str], panel: str, group: str) -> list[Picture]:
    """One picture per measure: a bar per variant and condition for the median of the samples."""
    measured = _measured(results)
    found = []
    for measure in measures or unique([cell.measure for cell in measured]):
        cells = [cell for cell in measured if cell.measure == measure]
        caption = f"{title}: {measure}, medians" if panel else f"{title}: {_measure_text(measure)}"
        make = partial(_panels, panel=panel, group=group) if panel else _amounts
        found += _picture(file_name(results.bench, measure), caption, cells, make)
    return found


def _measured(results: Results) -> list[Cell]:
    return [cell for cell in results.cells if finite(cell.samples)]


def _picture(
    name: str, caption: str, cells: Sequence[Cell], make: Callable[[Sequence[Cell], str], Figure]
) -> list[Picture]:
    """No picture without cells."""
    return [Picture(name, caption, lambda: make(cells, caption))] if cells else []


def _dots(cells: Sequence[Cell], title: str) -> Figure:
    kinds = unique([_kind(cell) for cell in cells])
    figure, every = panels(len(kinds), 3, (3.6, 2.9), title)
    style_of = styles(unique([cell.variant for cell in cells]))
    spread = np.random.default_rng(1)
    for axes, kind in zip(every, kinds, strict=True):
        shown = [cell for cell in cells if _kind(cell) == kind]
        for at, cell in enumerate(shown):
            samples, style = finite(cell.samples), style_of[cell.variant]
            beside = spread.uniform(-0.16, 0.16, len(samples))
            axes.scatter(at + beside, samples, s=18, color=style.colour, marker=style.marker, alpha=0.65, linewidths=0)
            middle = statistics.median(percentile(finite(one), 50) for one in cell.rounds if finite(one))
            axes.plot([at - 0.3, at + 0.3], [middle, middle], color="#222", linewidth=1.5)
            axes.annotate(
                digits(middle), (at + 0.32, middle), fontsize=8, va="center", annotation_clip=False,
            )  # fmt: skip
        axes.set_xticks(range(len(shown)), [short(cell.variant, 14) for cell in shown])
        axes.set_xlim(-0.6, len(shown) - 0.2)
        axes.set_ylim(0, 1.08 * max(sample for cell in shown for sample in finite(cell.samples)) or 1.0)
        axes.grid(visible=False, axis="x")
        axes.set_title("\n".join(short(line, 40) for line in kind.split("\n")), loc="left")
        axes.set_ylabel(f"time, {unit_of(shown[0].unit)}")
    return figure


def _kind(cell: Cell) -> str:
    return f"{cell.measure}\n{place(cell)}".strip()


def _panels(cells: Sequence[Cell], title: str, *, panel: str, group: str) -> Figure:
    """A panel for each value of the parameter ``panel``, in which ``group`` names the bars; the sum comes last."""

    def group_of(cell: Cell) -> str:
        return str(cell.params.get(group, ""))

    phases = unique([str(cell.params.get(panel, "")) for cell in cells])
    groups = sorted(unique([group_of(cell) for cell in cells]), key=lambda name: name == _SUM)
    end = 1.14 * max(percentile(finite(cell.samples), 50) for cell in cells)
    style_of = styles(unique([cell.variant for cell in cells]))
    size = (5.2, 0.9 + 0.17 * len(groups) * len(style_of) + 0.1 * len(groups))
    figure, every = panels(len(phases), 2, size, title)
    for axes, phase in zip(every, phases, strict=True):
        _grouped(axes, [cell for cell in cells if str(cell.params.get(panel, "")) == phase], groups, group_of, style_of)
        axes.set_xlim(0, end or 1.0)
        axes.set_title(short(phase, 50), loc="left")
        axes.set_xlabel(_axis(cells[0]))
    _squares(figure, style_of)
    return figure


def _amounts(cells: Sequence[Cell], title: str) -> Figure:
    groups = unique([place(cell) for cell in cells])
    variants = unique([cell.variant for cell in cells])
    figure, (axes,) = panels(1, 1, (8.5, 0.8 + 0.25 * len(groups) + 0.2 * len(cells)), title)
    style_of = styles(variants)
    if len(groups) == 1 or len(variants) * len(groups) == len(cells):
        _grouped(axes, cells, groups, place, style_of)
        _squares(figure, style_of)
    else:  # most variants have conditions of their own: each bar has its full name as label
        _grouped(axes, cells, unique([_name(cell) for cell in cells]), _name, style_of)
    axes.set_xlabel(_axis(cells[0]))
    return figure


def _squares(figure: Figure, style_of: dict[str, Style]) -> None:
    legend(figure, {name: Style(style.colour, "", "s") for name, style in style_of.items()}, lines=False)


def _name(cell: Cell) -> str:
    return f"{cell.variant}, {place(cell)}".removesuffix(", ")


def _grouped(
    axes: Axes, cells: Sequence[Cell], groups: Sequence[str], group: Callable[[Cell], str], style_of: dict[str, Style]
) -> None:
    """Bars with their values; within a group the variants that exist, without gaps."""
    longest = max((percentile(finite(cell.samples), 50) for cell in cells), default=0.0)
    for at, name in enumerate(groups):
        members = [cell for cell in cells if group(cell) == name]
        if not members:
            axes.annotate(" not running", (0, at), fontsize=8, va="center", color="#777")
        for number, cell in enumerate(members):
            value = percentile(finite(cell.samples), 50)
            y = at + _BAR * ((number + 0.5) / len(members) - 0.5)
            axes.barh(y, value, height=min(0.5, 0.9 * _BAR / len(members)), color=style_of[cell.variant].colour)
            axes.annotate(f" {digits(value)}", (value, y), fontsize=8, va="center")
    _names(axes, [name or "all" for name in groups])
    axes.set_xlim(0, 1.14 * longest or 1.0)


def _names(axes: Axes, names: Sequence[str]) -> None:
    axes.set_yticks(range(len(names)), [short(name, _LONGEST) for name in names])
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.grid(visible=False, axis="y")


def _tails(cells: Sequence[Cell], title: str) -> Figure:
    conditions = unique([place(cell) for cell in cells])
    variants = unique([cell.variant for cell in cells])
    figure, every = panels(len(conditions), 2, (5.0, 0.9 + 0.32 * len(variants)), title)
    style_of = styles(variants)
    ends = [(percentile(finite(cell.samples), 50), percentile(finite(cell.samples), 99)) for cell in cells]
    left, right = 0.5 * min((low for low, _ in ends if low > 0), default=1.0), 9 * max(high for _, high in ends)
    for axes, condition in zip(every, conditions, strict=True):
        log_axis(axes, "x", f"latency, {unit_of(cells[0].unit)}", left, right)
        for cell, (middle, high) in zip(cells, ends, strict=True):
            if place(cell) == condition:
                at = variants.index(cell.variant)
                axes.barh(at, middle - left, left=left, height=0.62, color=style_of[cell.variant].colour, alpha=0.75)
                axes.plot([middle, high], [at, at], color="#222", linewidth=1.1)
                axes.plot(high, at, marker="|", color="#222", markersize=7, markeredgewidth=1.3)
                axes.annotate(f"  {digits(middle)} / {digits(high)}", (high, at), fontsize=8, va="center")
        _names(axes, variants)
        axes.set_title(short(condition, 50), loc="left")
    return figure


def _axis(cell: Cell) -> str:
    unit = "% of one core" if (cell.measure, cell.unit) == ("CPU", "%") else unit_of(cell.unit)
    return ", ".join(filter(None, (_measure_text(cell.measure), unit)))


def _measure_text(measure: str) -> str:
    return _WORDS.get(measure, measure)
