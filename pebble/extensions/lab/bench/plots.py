"""Draws the charts of comparisons: distributions, and lines. matplotlib is imported only to draw."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pebble.extensions.lab.bench.results import FLOOR, STAND_IN, Cell, grouped, naming_in_errors, percentile
from pebble.extensions.lab.bench.show import Picture, digits

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_DPI = 150
_WIDEST = 13.0  # inches
_LEAST = 20  # samples for a distribution
_SETTINGS: dict[Any, Any] = {
    "font.size": 9, "axes.titlesize": 9, "figure.titlesize": 11, "xtick.labelsize": 8, "ytick.labelsize": 8,
    "axes.spines.top": False, "axes.spines.right": False, "axes.titlelocation": "left",
    "axes.grid": True, "axes.axisbelow": True, "grid.color": "#e4e4e4",
}  # fmt: skip


# -- the kinds of pictures


def curves(name: str, caption: str, cells: Sequence[Cell]) -> list[Picture]:
    """Return charts of distributions, a panel for each condition: the share of messages that arrived within a time."""
    shown_cells = [cell for cell in cells if len(cell.samples) >= _LEAST]
    caption = f"{caption}. Share of all messages, lost ones included, within the time"
    return [Picture(name, caption, partial(_curves, shown_cells, caption))] if shown_cells else []


def _curves(cells: Sequence[Cell], title: str) -> Figure:
    """Return the figure. A curve ends below 100 % by the share of lost messages; the slowest few are cut off."""
    by_condition, style_of = grouped(cells, Cell.conditions), styles([cell.variant for cell in cells])
    figure, all_axes = panels(len(by_condition), 3, (3.9, 2.7), title)
    ends = log_limits([percentile(cell.samples, percent) for cell in cells for percent in (0.1, 99.8)])
    for axes, (condition, group) in zip(all_axes, by_condition.items(), strict=True):
        for cell in group:
            times, style = sorted(cell.samples), style_of[cell.variant]
            step = 100 / (len(times) + (cell.lost or 0))
            shares = [step * count for count in range(1, len(times) + 1)]
            axes.plot(times, shares, **{**style, "marker": ""})
        log_axis(axes, "x", f"latency, {_unit(cells[0])}", *ends)
        axes.set(ylim=(0, 101), title=condition)
        for percent in (50, 99):
            guide(axes, percent, f"p{percent}")
    legend(figure, style_of)
    return figure


def lines(name: str, caption: str, cells: Sequence[Cell], *, over: str) -> list[Picture]:
    """Return charts of the medians as lines over the parameter ``over``; one panel for each measure."""
    shown_cells = [cell for cell in cells if cell.samples]
    return [Picture(name, caption, partial(_lines, shown_cells, caption, over))] if shown_cells else []


def _lines(cells: Sequence[Cell], title: str, over: str) -> Figure:
    """Return the figure: for each measure a chart of the medians of each variant, over the parameter ``over``."""
    by_measure, style_of = grouped(cells, lambda cell: cell.measure), styles([cell.variant for cell in cells])
    figure, all_axes = panels(len(by_measure), 3, (3.9, 3.0), title)
    for axes, (measure, group) in zip(all_axes, by_measure.items(), strict=True):
        for variant, cells_of_variant in grouped(group, lambda cell: cell.variant).items():
            points = sorted((float(str(cell.params[over])), cell.percentile(50)) for cell in cells_of_variant)
            axes.plot(*zip(*points, strict=True), **style_of[variant])
            last_median = points[-1][1]
            axes.annotate(f"  {digits(last_median)}", points[-1], fontsize=8, va="center", annotation_clip=False)
        positions = [float(str(cell.params[over])) for cell in group]
        log_axis(axes, "x", over, 0.8 * min(positions), 2.5 * max(positions))  # space for the last number
        top = 1.15 * max(cell.percentile(50) for cell in group) or 1.0
        axes.set(ylim=(0, top), ylabel=f"{measure}, {_unit(group[0])}")
    legend(figure, style_of)
    return figure


def _unit(cell: Cell) -> str:
    return {"us": "µs", "%": "% of a core"}.get(cell.unit, cell.unit)


# -- the common style of all pictures: colours of the variants, panels, axes, legends

Style = dict[str, Any]  # keywords of a line

#: Blue is Zenoh, red MQTT, brown the stand-in.
_COLOURS: dict[str, str] = {
    "zenoh": "#0072B2", "zenoh-p2p": "#0072B2", "zenoh-shm": "#0072B2", "zenoh h264 opus": "#0072B2",
    "zenoh original": "#56B4E9", "mqtt": "#D55E00", "mqtt h264 opus": "#D55E00", "mqtt original": "#E69F00",
    STAND_IN: "#8C510A", FLOOR: "#000000",
    "gstreamer-shm": "#8A8A8A", "page": "#8A8A8A", "each by itself": "#D55E00", "groups": "#E69F00",
    "groups, deflate": "#56B4E9", "groups, deflate, short name": "#0072B2",
}  # fmt: skip


def styles(variants: Sequence[str]) -> dict[str, Style]:
    """Return the style of each variant. Dash and marker differ as well, for colour-blind readers."""
    return {
        name: {"color": _COLOURS[name], "linestyle": ("-", "--", "-.", ":")[number % 4], "marker": "os^DvP"[number % 6],
               "markersize": 5, "markerfacecolor": "white" if "original" in name else _COLOURS[name]}
        for number, name in enumerate(dict.fromkeys(variants))
    }  # fmt: skip


def panels(count: int, columns: int, size: tuple[float, float], title: str) -> tuple[Figure, list[Axes]]:
    """Return a figure with ``count`` panels of ``size`` inches each, as many in a row as fit."""
    from matplotlib.figure import Figure

    columns = min(columns, count)
    rows = math.ceil(count / columns)
    width = max(5.5, min(_WIDEST, columns * size[0]))
    figure = Figure(figsize=(width, rows * size[1] + 0.9), dpi=_DPI, layout="constrained")
    characters = int(width * 11.5) - 14  # 11.5 fit in an inch; 14 leave room for “quick run” beside the title
    figure.suptitle(textwrap.fill(title, characters), x=0.01, ha="left")
    return figure, [figure.add_subplot(rows, columns, number + 1) for number in range(count)]


def legend(figure: Figure, entries: dict[str, Style]) -> None:
    """Add a legend below the panels."""
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], label=name, **style) for name, style in entries.items()]
    columns = max(1, min(len(handles), int(figure.get_figwidth() // 1.8)))
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, frameon=False)


def save(picture: Picture, folder: Path, *, quick: bool) -> Path:
    """Draw a PNG; a quick run is marked in the corner. Raises PebbleError if it cannot be written."""
    import matplotlib as mpl

    path = folder / f"{picture.name}.png"
    with mpl.rc_context(_SETTINGS), naming_in_errors(path):
        figure = picture.make()
        if quick:
            figure.text(0.995, 0.993, "quick run", ha="right", va="top", color="#A4133C", weight="bold")
        figure.savefig(path, dpi="figure")
    return path


def log_axis(axes: Axes, which: str, label: str, low: float, high: float) -> None:
    """Set a logarithmic axis from ``low`` to ``high``, with written-out numbers."""
    settings: dict[str, Any] = {f"{which}scale": "log", f"{which}lim": (low, high), f"{which}label": label}
    axes.set(**settings)
    (axes.xaxis if which == "x" else axes.yaxis).set_major_formatter("{x:,.12g}")


def log_limits(values: Sequence[float]) -> tuple[float, float]:
    """Return the ends of a logarithmic axis that holds all positive values with some margin."""
    positive = [value for value in values if 0 < value < math.inf] or [1.0]
    return 0.75 * min(positive), 1.4 * max(positive)


def guide(axes: Axes, value: float, text: str) -> None:
    """Draw a thin line at a reference value, with its name at the end."""
    axes.axhline(value, color="#8a8a8a", linewidth=0.8, linestyle=(0, (4, 3)), zorder=1)
    axes.annotate(
        text, (1.0, value), xycoords=axes.get_yaxis_transform(), xytext=(4, 0), textcoords="offset points", fontsize=8,
        color="#555", ha="left", va="center", annotation_clip=False,
    )  # fmt: skip
