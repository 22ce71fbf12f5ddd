"""Figures 4.1 to 4.6 of the paper, drawn as `pebble analyse` draws them, in one picture."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Final

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pebble.bench.plots_style import Picture, panels
from pebble.bench.results import Results
from pebble.bench.traffic_report import robots_of
from pebble.recordings.traffic.figures import draw_bandwidth, draw_latency, draw_outages
from pebble.recordings.traffic.results import IDLE, SESSION, RobotTraffic

_PANEL: Final = (5.6, 3.0)  # inches
_ABOVE: Final = 22.0  # points for the legend between a panel and its title


def traffic_figures(results: Results) -> list[Picture]:
    """Of those of the paper's robots that were analysed; no picture without one."""
    robots = robots_of(results)
    shown = [(number, *one) for number, one in _FIGURES.items() if one[0] in robots]
    caption = "Figures 4.1 to 4.6 of the paper, with simulated robots on this machine"
    return [Picture("traffic-figures", caption, partial(_make, robots, shown))] if shown else []


def _make(robots: dict[str, RobotTraffic], shown: list[tuple[str, str, str, _Draw]]) -> Figure:
    figure, places = panels(len(shown), 2, _PANEL, "Traffic of simulated robots: the paper's Figures 4.1 to 4.6")
    for axes, (number, name, what, draw) in zip(places, shown, strict=True):
        draw(axes, robots[name])
        axes.set_title(f"Figure {number}: {name}, {what}", loc="left", pad=_ABOVE, weight="bold")
    return figure


def _latency(axes: Axes, robot: RobotTraffic) -> None:
    if robot.latency is not None:
        draw_latency(axes, robot.latency)


def _bandwidth(axes: Axes, robot: RobotTraffic) -> None:
    shown = [one for one in robot.bandwidth if one.time in (SESSION, IDLE)]
    if shown:
        draw_bandwidth(axes, shown)


_Draw = Callable[[Axes, RobotTraffic], None]
_FIGURES: Final[dict[str, tuple[str, str, _Draw]]] = {
    "4.1": ("goob", "outages of heartbeats", draw_outages),
    "4.2": ("goob", "latency of heartbeats", _latency),
    "4.3": ("minilamp", "bandwidth", _bandwidth),
    "4.4": ("minilamp", "outages of heartbeats", draw_outages),
    "4.5": ("benjr", "latency of heartbeats", _latency),
    "4.6": ("minilamp", "latency of heartbeats", _latency),
}
