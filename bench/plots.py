"""The common style of all pictures: colours of the variants, panels, axes, legends. matplotlib is imported to draw."""

from __future__ import annotations

import io
import math
import re
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pebble.bench.results import Cell, Results, named

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

_DPI = 150
_COLOURS = 255  # of the palette, which reduces files to a third
_FEW_DECADES = {"x": 2.5, "y": 3.2}  # a logarithmic axis with fewer decades has ticks between the powers of ten
_GREY = "#8a8a8a"
_BACKGROUND = "white"
_WIDEST = 13.0  # inches

_SETTINGS: dict[Any, Any] = {
    "font.size": 9,
    "font.family": "DejaVu Sans",
    "axes.titlesize": 9,
    "axes.labelsize": 9,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "legend.fontsize": 8.5,
    "figure.titlesize": 11,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.5,
    "figure.facecolor": _BACKGROUND,
}

Dash = Literal["-", "--", "-.", ":", ""]


@dataclass(frozen=True, slots=True)
class Style:
    """The style of a variant in every picture. Dash and marker differ as well, for colour-blind readers."""

    colour: str
    dash: Dash = "-"
    marker: str = "o"
    hollow: bool = False


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture: its file name without ending, its caption, and the function that draws it."""

    name: str
    caption: str
    make: Callable[[], Figure]


_BLUES = ("#0072B2", "#2AA198", "#56B4E9", "#1B3A6B")
_REDS = ("#D55E00", "#E69F00", "#A4133C", "#8C510A")
_GREYS = ("#4d4d4d", "#8a8a8a", "#1a1a1a", "#b3b3b3")
_GREENS = ("#117733", "#6DBE8B")
_DASHES: tuple[Dash, ...] = ("-", "--", "-.", ":")
_MARKERS = ("o", "s", "^", "D", "v", "P")
_SHARED = {
    Style(_BLUES[0]): ("zenoh", "zenoh-p2p", "zenoh-shm", "zenoh h264 opus"),
    Style(_BLUES[1], "--", "s"): ("zenoh-hub", "zenoh-copy"),
    Style(_BLUES[2], "-.", "^"): ("zenoh-net",),
    Style(_BLUES[2], "--", "s", hollow=True): ("zenoh original",),
    Style(_REDS[0], marker="D"): ("mqtt", "mqtt h264 opus"),
    Style(_REDS[1], "--", "v"): ("mqtt-nodelay",),
    Style(_REDS[1], "--", "v", hollow=True): ("mqtt original",),
    Style(_REDS[2], "-.", "P"): ("mqtt5",),
    Style(_REDS[3], ":", "X"): ("paho",),
    Style(_GREYS[0], ":", "X"): ("one hop", "memcpy"),
    Style(_GREYS[1], "--", "v"): ("gstreamer-shm",),
    Style(_GREYS[1]): ("json", "pcm"),
    Style(_GREYS[3]): ("reference",),
    Style("#CC79A7", "--", "s"): ("pbvd",),
    Style("#7B4F9E", "-.", "^"): ("pbvz",),
    Style(_GREENS[0], marker="D"): ("h264", "opus"),
    Style(_GREENS[1], ":", "v"): ("h264, key/5",),
}
_KNOWN = {name: style for style, names in _SHARED.items() for name in names}


def styles(variants: Sequence[str]) -> dict[str, Style]:
    """The fixed style of each known variant, and one from its family's colours for every other."""
    found = {name: _KNOWN[name] for name in variants if name in _KNOWN}
    for name in variants:
        if name not in found:
            family = _BLUES if name.startswith("zenoh") else _REDS if name.startswith(("mqtt", "paho")) else _GREYS
            used, turn = {style.colour for style in found.values()}, len(found)
            colour = next((one for one in family if one not in used), family[turn % len(family)])
            found[name] = Style(colour, _DASHES[turn % len(_DASHES)], _MARKERS[turn % len(_MARKERS)])
    return {name: found[name] for name in variants}


def unique(values: Sequence[str]) -> list[str]:
    """In the order of their first appearance."""
    return list(dict.fromkeys(values))


def file_name(*words: str) -> str:
    """Converts text such as ``one-way there, ± 0.4 ms`` to a file name."""
    return "-".join(re.sub(r"[^a-z0-9]+", "-", word.lower()).strip("-") for word in words)


def finite(samples: Sequence[float | None]) -> list[float]:
    """The finite samples, without NaN and None."""
    return [sample for sample in samples if sample is not None and math.isfinite(sample)]


def place(cell: Cell) -> str:
    """The conditions of a cell as text: ``40 B, 200 Hz, with media``."""
    words = []
    for name, value in cell.params.items():
        if name == "load":
            words.append("" if value in (None, "none") else f"with {value}")
        elif value is None or isinstance(value, str):
            words.append(value or "")
        else:
            words.append(f"{value} {name.removesuffix('s') if value == 1 else name}")
    return ", ".join(filter(None, words)) or ("unloaded" if "load" in cell.params else "")


def short(text: str, width: int = 30) -> str:
    """Wraps long names to two lines and truncates them."""
    return "\n".join(textwrap.wrap(text, width, max_lines=2, placeholder="…")) or text


def panels(count: int, columns: int, size: tuple[float, float], title: str) -> tuple[Figure, list[Axes]]:
    """A figure with ``count`` panels of ``size`` inches each, as many in a row as fit."""
    from matplotlib.figure import Figure

    columns = max(1, min(columns, count))
    rows = math.ceil(count / columns)
    width = max(5.5, min(_WIDEST, columns * size[0]))
    figure = Figure(figsize=(width, rows * size[1] + 0.9), dpi=_DPI, layout="constrained")
    wrapped = "\n".join(textwrap.wrap(title, int(width * 11.5) - 14))  # leaves room for the “quick run” mark
    figure.suptitle(wrapped, x=0.01, ha="left")
    return figure, [figure.add_subplot(rows, columns, number + 1) for number in range(count)]


def legend(figure: Figure, entries: dict[str, Style], *, more: Sequence[Line2D] = ()) -> None:
    """Adds a legend below the panels."""
    from matplotlib.lines import Line2D

    handles = [
        Line2D(
            [], [], color=style.colour, label=short(name, 40), linestyle=style.dash,
            marker=style.marker, markersize=5, markerfacecolor=_BACKGROUND if style.hollow else style.colour,
        )
        for name, style in entries.items()
    ]  # fmt: skip
    handles += more
    columns = max(1, min(len(handles), int(figure.get_figwidth() // 1.8)))
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, frameon=False)


def save(picture: Picture, path: Path, results: Results) -> None:
    """Draws a PNG with a palette; a quick run is marked in the corner. Raises PebbleError if it cannot be written."""
    import matplotlib as mpl
    from PIL import Image

    buffer = io.BytesIO()
    with mpl.rc_context(_SETTINGS):
        figure = picture.make()
        if results.quick:
            figure.text(0.995, 0.993, "quick run", ha="right", va="top", color="#A4133C", weight="bold")
        figure.savefig(buffer, format="png", dpi="figure")
    drawn = Image.open(buffer).convert("RGB")
    image = drawn.quantize(_COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    with named(path):
        image.save(path, optimize=True, dpi=(_DPI, _DPI))


def log_axis(axes: Axes, which: str, label: str, low: float, high: float) -> None:
    """Sets a logarithmic axis from ``low`` to ``high``, with written-out numbers for any number of decades."""
    from matplotlib.ticker import LogLocator

    limits: dict[str, Any] = {f"{which}scale": "log", f"{which}lim": (low, high)}
    axes.set(**limits)
    axis, decades = axes.xaxis if which == "x" else axes.yaxis, math.log10(high / low)
    few = decades <= _FEW_DECADES[which]
    steps = (1.0,) if not few else (1.0, 2.0, 5.0) if decades > 0.5 else tuple(range(1, 10))
    axis.set_major_locator(LogLocator(subs=steps, numticks=20))
    axis.set_major_formatter("{x:,.12g}")
    axis.set_minor_formatter("")
    if few:
        axis.set_ticks([], minor=True)
    axis.set_label_text(label)


def around(values: Sequence[float | None]) -> tuple[float, float]:
    """Ends of a logarithmic axis with some margin around all positive values."""
    positive = [value for value in finite(values) if value > 0] or [1.0]
    return 0.75 * min(positive), 1.4 * max(positive)


def unit_of(unit: str) -> str:
    return "µs" if unit == "us" else unit


def guide(axes: Axes, value: float, text: str) -> None:
    """Draws a thin line at a reference value, with its name at the end."""
    axes.axhline(value, color=_GREY, linewidth=0.8, linestyle=(0, (4, 3)), zorder=1)
    axes.annotate(
        text, (1.0, value), xycoords=axes.get_yaxis_transform(), xytext=(4, 0), textcoords="offset points", fontsize=8,
        color="#555", ha="left", va="center", annotation_clip=False,
    )  # fmt: skip
