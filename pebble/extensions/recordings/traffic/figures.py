"""The figures of an analysis as SVG: Figures 4.1 to 4.6 of the paper, for every robot."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

from msgspec import Struct

from pebble.extensions.recordings.traffic.results import FAMILIES, IDLE, MCU, SESSION, Bandwidth, Latency, RobotTraffic

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Colours that colour-blind readers can tell apart (Okabe and Ito).
_BLUE, _ORANGE, _GREEN, _RED = "#0072B2", "#E69F00", "#009E73", "#D55E00"
_SETTINGS: Final[dict[Any, Any]] = {
    "font.family": "sans-serif",
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.6,
    "svg.fonttype": "none",  # text stays text
    "text.parse_math": False,
}
_SIZE: Final = (4.6, 2.8)  # inches
_LONGEST_MS, _BIN_MS = 3000, 50
_TIMES: Final = ((SESSION, "in sessions", _BLUE, -0.14, "o"), (IDLE, "idle", _ORANGE, 0.14, "s"))
_LEAST_KBPS: Final = 0.01  # a logarithmic axis has no 0
_TALL: Final = 30  # a highest bar of so many times the lowest makes the axis logarithmic


class Figure(Struct, frozen=True):
    """A drawing with a text that explains it to a new reader."""

    number: str  # in the paper
    title: str
    caption: str
    svg: str


def figures(robot: RobotTraffic) -> list[Figure]:
    """Return the figures for which a robot has data."""
    drawn = [_outages(robot), _latency(robot), _bandwidth(robot)]
    return [figure for figure in drawn if figure is not None]


def _outages(robot: RobotTraffic) -> Figure | None:
    if robot.interval_ms is None:
        return None
    number = "Figure 4.4" if robot.machine == MCU else "Figure 4.1"
    caption = (
        f"A heartbeat comes every {robot.interval_ms:.0f} ms. When one is missing, this counts by how much longer than "
        "usual the robot was silent."
    )
    return Figure(number, "Heartbeat outages", caption, _svg(lambda axes: draw_outages(axes, robot), robot, "outages"))


def draw_outages(axes: Axes, robot: RobotTraffic) -> None:
    """Draw the number of outages of each length."""
    if not robot.outages:
        axes.set_axis_off()
        axes.text(0.5, 0.5, "no outage", ha="center", va="center", transform=axes.transAxes, color="#555")
        return
    edges = [start * _BIN_MS for start in range(_LONGEST_MS // _BIN_MS + 1)]
    lengths = [min(outage.length_ms, _LONGEST_MS - 1) for outage in robot.outages]
    counts = axes.hist(lengths, bins=edges, color=_BLUE)[0]
    _scale_counts(axes, [float(count) for count in counts])
    axes.set_xlim(0, _LONGEST_MS)
    axes.set_xlabel("ms longer than usual; the last bar: 3 s and more")
    axes.set_ylabel("outages")


def _latency(robot: RobotTraffic) -> Figure | None:
    latency = robot.latency
    if latency is None:
        return None
    number = "Figures 4.5 and 4.6" if robot.machine == MCU else "Figure 4.2"
    caption = (
        "The time from a heartbeat's own stamp to its reception by the recorder. It depends on both clocks: only "
        "differences between values are certain. Values below 0 show that the robot's clock is ahead."
    )
    svg = _svg(lambda axes: draw_latency(axes, latency), robot, "latency")
    return Figure(number, "Latency of heartbeats", caption, svg)


def draw_latency(axes: Axes, latency: Latency) -> None:
    """Draw the histogram of latencies, with its median and 95th percentile."""
    bars = latency.histogram
    lefts = [bars.low + number * bars.width for number in range(len(bars.counts))]
    axes.bar(lefts, bars.counts, width=bars.width, align="edge", color=_BLUE)
    for value, text, colour, style in (
        (latency.median_ms, "median", _RED, "-"),
        (latency.p95_ms, "95 % below", _GREEN, "--"),
    ):
        axes.axvline(value, color=colour, linestyle=style, label=f"{text}: {value:.0f} ms")
    axes.set_xlim(lefts[0], lefts[-1] + bars.width)
    axes.set_xlabel("ms; the last bar: this and more")
    axes.set_ylabel("heartbeats")
    _legend(axes)


def _bandwidth(robot: RobotTraffic) -> Figure | None:
    shown = [bandwidth for bandwidth in robot.bandwidth if bandwidth.time in (SESSION, IDLE)]
    if not shown:
        return None
    caption = (
        "What each kind of message takes: the mark and the number are the median of the seconds with such messages, "
        "the line ends where 95 % of them stay below. The scale is logarithmic: each step is ten times as much."
    )
    svg = _svg(lambda axes: draw_bandwidth(axes, shown), robot, "bandwidth")
    return Figure("Figure 4.3", "Bandwidth in sessions and while idle", caption, svg)


def draw_bandwidth(axes: Axes, shown: Sequence[Bandwidth]) -> None:
    """Draw the median and the 95th percentile of each kind of message (``family``), in sessions and while idle."""
    present = {bandwidth.family for bandwidth in shown}
    names = [family for family in reversed(FAMILIES) if family in present]
    for time, label, colour, offset, marker in _TIMES:
        of_time = [bandwidth for bandwidth in shown if bandwidth.time == time]
        places = [names.index(bandwidth.family) - offset for bandwidth in of_time]
        medians = [max(bandwidth.median_kbps, _LEAST_KBPS) for bandwidth in of_time]
        rights = [max(bandwidth.p95_kbps, _LEAST_KBPS) for bandwidth in of_time]
        axes.hlines(places, medians, rights, color=colour, linewidth=2)
        axes.plot(medians, places, marker, color=colour, markersize=6, label=label)
        for bandwidth, right, place in zip(of_time, rights, places, strict=True):
            axes.annotate(
                _short(bandwidth.median_kbps), (right, place), xytext=(6, 0), textcoords="offset points", va="center",
                fontsize=7, color="#333",
            )  # fmt: skip
    values = [max(kbps, _LEAST_KBPS) for bandwidth in shown for kbps in (bandwidth.median_kbps, bandwidth.p95_kbps)]
    axes.set_xscale("log")
    axes.set_xlim(10 ** math.floor(math.log10(min(values) * 0.7)), max(values) * 4)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.xaxis.set_minor_formatter(lambda _value, _: "")
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(-0.6, len(names) - 0.4)
    axes.set_xlabel("kbit/s")
    _legend(axes)


def _legend(axes: Axes) -> None:
    """Draw the legend above the drawing, so that it hides nothing."""
    axes.legend(frameon=False, fontsize=8, loc="lower left", bbox_to_anchor=(0, 1), ncols=2, borderaxespad=0.2)


def _scale_counts(axes: Axes, counts: Sequence[float]) -> None:
    """Scale the axis of counts: logarithmic if the largest is far above the smallest, else in whole numbers."""
    present = [count for count in counts if count > 0]
    if max(present) > _TALL * min(present):
        axes.set_yscale("log")
        axes.set_ylim(bottom=0.7)  # below 1, so that a count of 1 is seen
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    else:
        axes.locator_params(axis="y", integer=True, min_n_ticks=1)


def _short(value: float) -> str:
    return f"{value:.1f}" if value < 1000 else f"{value:,.0f}"


def _svg(draw: Any, robot: RobotTraffic, name: str) -> str:
    """Return the figure as SVG for a page: without ids, which could clash with another's, and without foreign URLs."""
    import matplotlib as mpl
    from matplotlib.figure import Figure as Drawing

    out = io.StringIO()
    with mpl.rc_context({**_SETTINGS, "svg.hashsalt": f"{robot.robot} {name}"}):
        drawing = Drawing(figsize=_SIZE, layout="constrained")
        draw(drawing.add_subplot())
        drawing.savefig(out, format="svg", metadata={"Date": None}, transparent=True)
    text = out.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, count=1, flags=re.DOTALL)
    text = re.sub(r' xmlns(:\w+)?="[^"]*"', "", text)
    text = re.sub(r'<g id="[^"]*"', "<g", text)
    text = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", text, count=1)  # the page sets both sizes
    return re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", text, count=1)
