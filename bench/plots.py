"""The common style of all pictures: colours of the variants, panels, axes, legends. matplotlib is imported to draw."""

from __future__ import annotations

import io
import math
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pebble.bench.results import Results, named

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

_DPI = 150
_WIDEST = 13.0  # inches
_SETTINGS: dict[Any, Any] = {
    "font.size": 9, "axes.titlesize": 9, "figure.titlesize": 11, "xtick.labelsize": 8, "ytick.labelsize": 8,
    "axes.spines.top": False, "axes.spines.right": False, "axes.titlelocation": "left",
    "axes.grid": True, "axes.axisbelow": True, "grid.color": "#e4e4e4",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Style:
    """The style of a variant in every picture. Dash and marker differ as well, for colour-blind readers."""

    colour: str
    dash: Any = "-"
    marker: str = "o"
    hollow: bool = False


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture: its file name without ending, its caption, and the function that draws it."""

    name: str
    caption: str
    make: Callable[[], Figure]


#: The variants of each colour. The first four are for other ones of Zenoh, too, the next four of MQTT, the rest of all.
_VARIANTS: dict[str, tuple[str, ...]] = {
    "#0072B2": ("zenoh", "zenoh-p2p", "zenoh-shm", "zenoh h264 opus"),
    "#2AA198": ("zenoh-hub", "zenoh-copy"),
    "#56B4E9": ("zenoh-net", "zenoh original"),
    "#1B3A6B": (),
    "#D55E00": ("mqtt", "mqtt h264 opus"),
    "#E69F00": ("mqtt-nodelay", "mqtt original"),
    "#A4133C": ("mqtt5",),
    "#8C510A": ("paho",),
    "#4D4D4D": ("one hop", "memcpy"),
    "#8A8A8A": ("gstreamer-shm",),
    **dict.fromkeys(("#117733", "#6DBE8B", "#CC79A7", "#7B4F9E", "#1A1A1A", "#B3B3B3"), ()),
}
_STYLES = {
    colour: Style(colour, ("-", "--", "-.", ":")[at % 4], "os^DvPX"[at % 7]) for at, colour in enumerate(_VARIANTS)
}


def styles(variants: Sequence[str]) -> dict[str, Style]:
    """The fixed style of each known variant, and one from its family's colours for every other."""
    found = {name: colour for colour, names in _VARIANTS.items() for name in names if name in variants}
    for name in variants:
        begin, end = (0, 4) if name.startswith("zenoh") else (4, 8) if name.startswith(("mqtt", "paho")) else (8, None)
        family = list(_VARIANTS)[begin:end]
        found.setdefault(name, next((colour for colour in family if colour not in found.values()), family[0]))
    return {name: replace(_STYLES[found[name]], hollow="original" in name) for name in variants}


def unique(values: Sequence[str]) -> list[str]:
    """The values in the order of their first appearance."""
    return list(dict.fromkeys(values))


def finite(samples: Sequence[float | None]) -> list[float]:
    return [sample for sample in samples if sample is not None and math.isfinite(sample)]


def short(text: str, width: int = 30) -> str:
    """Wraps long names to two lines and truncates them."""
    return "\n".join(textwrap.wrap(text, width, max_lines=2, placeholder="…")) or text


def panels(count: int, columns: int, size: tuple[float, float], title: str) -> tuple[Figure, list[Axes]]:
    """A figure with ``count`` panels of ``size`` inches each, as many in a row as fit."""
    from matplotlib.figure import Figure

    columns = min(columns, count)
    rows = math.ceil(count / columns)
    width = max(5.5, min(_WIDEST, columns * size[0]))
    figure = Figure(figsize=(width, rows * size[1] + 0.9), dpi=_DPI, layout="constrained")
    figure.suptitle(textwrap.fill(title, int(width * 11.5) - 14), x=0.01, ha="left")  # beside it: “quick run”
    return figure, [figure.add_subplot(rows, columns, number + 1) for number in range(count)]


def legend(figure: Figure, entries: dict[str, Style], *, more: Sequence[Line2D] = ()) -> None:
    """Adds a legend below the panels."""
    from matplotlib.lines import Line2D

    handles = [
        Line2D(
            [], [], color=style.colour, label=short(name, 40), linestyle=style.dash,
            marker=style.marker, markersize=5, markerfacecolor="white" if style.hollow else style.colour,
        )
        for name, style in entries.items()
    ] + list(more)  # fmt: skip
    columns = max(1, min(len(handles), int(figure.get_figwidth() // 1.8)))
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, frameon=False)


def save(picture: Picture, path: Path, results: Results) -> None:
    """Draws a PNG; a quick run is marked in the corner. Raises PebbleError if it cannot be written."""
    import matplotlib as mpl
    from PIL import Image

    buffer = io.BytesIO()
    with mpl.rc_context(_SETTINGS):
        figure = picture.make()
        if results.quick:
            figure.text(0.995, 0.993, "quick run", ha="right", va="top", color="#A4133C", weight="bold")
        figure.savefig(buffer, format="png", dpi="figure")
    drawn = Image.open(buffer).convert("RGB")  # with a palette, a file is a third as large
    image = drawn.quantize(255, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    with named(path):
        image.save(path, optimize=True, dpi=(_DPI, _DPI))


def log_axis(axes: Axes, which: str, label: str, low: float, high: float) -> None:
    """Sets a logarithmic axis from ``low`` to ``high``, with written-out numbers for any number of decades."""
    from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

    limits: dict[str, Any] = {f"{which}scale": "log", f"{which}lim": (low, high), f"{which}label": label}
    axes.set(**limits)
    axis, decades = axes.xaxis if which == "x" else axes.yaxis, math.log10(high / low)
    steps = LogLocator(subs=(1.0,) if decades > 2.5 else (1.0, 2.0, 5.0), numticks=20)
    axis.set_major_locator(steps if decades > 0.5 else MaxNLocator(6, steps=(1, 2, 5, 10)))
    axis.set_major_formatter("{x:,.12g}")
    axis.set_minor_locator(NullLocator())


def around(values: Sequence[float | None]) -> tuple[float, float]:
    """Ends of a logarithmic axis with some margin around all positive values."""
    positive = [value for value in finite(values) if value > 0] or [1.0]
    return 0.75 * min(positive), 1.4 * max(positive)


def guide(axes: Axes, value: float, text: str) -> None:
    """Draws a thin line at a reference value, with its name at the end."""
    axes.axhline(value, color="#8a8a8a", linewidth=0.8, linestyle=(0, (4, 3)), zorder=1)
    axes.annotate(
        text, (1.0, value), xycoords=axes.get_yaxis_transform(), xytext=(4, 0), textcoords="offset points", fontsize=8,
        color="#555", ha="left", va="center", annotation_clip=False,
    )  # fmt: skip
