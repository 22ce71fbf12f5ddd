"""Pictures of robots on impaired networks, over the trials as in the paper's Figures 4.7 and 4.8."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from pebble.extensions.lab.bench.impair import metrics
from pebble.extensions.lab.bench.plots import Style, around, guide, legend, log_axis, panels, styles, unique
from pebble.extensions.lab.bench.results import Cell
from pebble.extensions.lab.bench.show import Picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: % of the audio delivered, "saturated near" (paper, section 4.2).
PAPER_BEST_PERCENT: Final = 80.0
PAPER_WORDS: Final = {"512k": "degraded", "256k": "broken"}
#: Results of the original program by trial, measured once, elsewhere, through such a network: all but fps of the audio.
ORIGINAL: Final = {
    "delivered_percent": {"256k": 40.0, "64k": 5.7},
    "on_time_percent": {"256k": 3.5},  # within a second
    "p95_ms": {"256k": 6900.0},
    "fps": {"256k": 2.2},
}
_CROSS: Final[dict[str, Any]] = {
    "color": "#1a1a1a", "marker": "x", "linestyle": "", "markersize": 7, "markeredgewidth": 2,
    "label": "the original program itself, measured once elsewhere",
}  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """A line for each subject over the trials: a value of the cells of a measure."""

    label: str
    measure: str
    value: str | Callable[[Cell], float]  # the name of a figure, or a function; not drawn if it is infinite
    log: bool = False
    crosses: Mapping[str, float] = field(default_factory=dict)  # the original's values by trial
    words: Mapping[str, str] = field(default_factory=dict)  # the paper's, by trial
    best: float | None = None  # the paper's best value

    def value_of(self, cell: Cell) -> float:
        return cell.middle(self.value) if isinstance(self.value, str) else self.value(cell)


def _percentile(percent: float) -> Callable[[Cell], float]:
    """Return a percentile of what arrived; the share that arrived is in another panel."""
    return lambda cell: cell.percentile(percent)


def _drive(measure: str) -> Panel:
    label = f"{measure.replace('during', 'with')}\np95, ms"
    return Panel(label=label, measure=measure, value=metrics.with_lost(95), log=True)


#: By name: the caption, the height of a panel in inches, and the panels.
_OVER_TRIALS: Final[dict[str, tuple[str, float, tuple[Panel, ...]]]] = {
    "audio-delivery": ("Audio delivery over the trials, in the form of the paper's Figure 4.7", 3.5, (
        Panel(label="audio that arrived, %", measure=metrics.SOUND, value="delivered_percent",
              crosses=ORIGINAL["delivered_percent"], words=PAPER_WORDS, best=PAPER_BEST_PERCENT),
        Panel(label="audio within 1 s, %", measure=metrics.SOUND, value="on_time_percent",
              crosses=ORIGINAL["on_time_percent"]),
    )),
    "audio-latency": (
        "Latency of the audio that arrived, over the trials, in the form of the paper's Figure 4.8", 3.3, (
        Panel(label="audio latency p50, ms", measure=metrics.SOUND, value=_percentile(50), log=True),
        Panel(label="audio latency p95, ms", measure=metrics.SOUND, value=_percentile(95), log=True,
              crosses=ORIGINAL["p95_ms"]),
    )),
    "video": ("Video over the trials: frame rate, and how long it froze", 2.7, (
        Panel(label="pictures per second", measure=metrics.PICTURES, value="fps", crosses=ORIGINAL["fps"]),
        Panel(label="frozen, s\n(gaps over 1 s)", measure=metrics.PICTURES, value="frozen_s"),
        Panel(label="longest gap, s", measure=metrics.PICTURES, value="longest_gap_s", log=True),
    )),
    "drive": ("Drive commands and heartbeat over the trials (no point: more than 5 % of the commands were lost)", 2.3, (
        _drive(metrics.DRIVE_ALONE), _drive(metrics.DRIVE_VIDEO), _drive(metrics.DRIVE_AUDIO),
        Panel(label="robot seen offline,\nlongest, s", measure=metrics.HEARTBEAT_GAP, value="longest_offline_s"),
    )),
}  # fmt: skip


def over_trials(cells: Sequence[Cell], more: str) -> list[Picture]:
    """Return audio, video and commands over the trials; ``more`` is a part of their captions."""
    return [
        Picture(f"impair-{name}", f"{caption}; {more}", partial(_trials, cells, f"{caption}; {more}", height, shown))
        for name, (caption, height, shown) in _OVER_TRIALS.items()
    ]


def _trials(cells: Sequence[Cell], title: str, height: float, shown: Sequence[Panel]) -> Figure:
    """Draw all panels; logarithmic ones have one scale, to show waiting behind media."""
    from matplotlib.lines import Line2D

    figure, every = panels(len(shown), 1, (10.5, height), title)
    names = unique([str(cell.params["trial"]) for cell in cells])
    style_of = styles(unique([cell.variant for cell in cells]))
    seen = [_lines(axes, cells, names, style_of, panel) for axes, panel in zip(every, shown, strict=True)]
    ends = around([one for panel, values in zip(shown, seen, strict=True) if panel.log for one in values])
    for axes, panel, values in zip(every, shown, seen, strict=True):
        top = max([*values, 1.0])
        if panel.log:
            log_axis(axes, "y", panel.label, *ends)
        else:
            axes.set(ylabel=panel.label, ylim=(-0.04 * top, 1.1 * top))
        axes.set_xlim(-0.6, len(names) - 0.4)
        axes.set_xticks(range(len(names)), [])
    every[-1].set_xticks(range(len(names)), names, rotation=40, ha="right", rotation_mode="anchor")
    every[-1].set_xlabel("trial: condition of the network, in the order of the run")
    legend(figure, style_of, more=[Line2D([], [], **_CROSS)] if any(panel.crosses for panel in shown) else [])
    return figure


def _lines(
    axes: Axes, cells: Sequence[Cell], names: Sequence[str], style_of: Mapping[str, Style], panel: Panel
) -> list[float]:
    """Draw one line per subject, and the references; returns all values."""
    value_of = {
        (cell.variant, str(cell.params["trial"])): value
        for cell in cells
        if cell.measure == panel.measure and math.isfinite(value := panel.value_of(cell))
    }
    for number, (subject, style) in enumerate(style_of.items()):
        beside = 0.06 * (number - (len(style_of) - 1) / 2)  # keeps equal values visible
        axes.plot(
            [at + beside for at in range(len(names))], [value_of.get((subject, trial), math.nan) for trial in names],
            color=style.colour, linestyle=style.dash, marker=style.marker,
            markersize=5, linewidth=1.2, markerfacecolor="white" if style.hollow else style.colour,
        )  # fmt: skip
    crosses = {names.index(trial): value for trial, value in panel.crosses.items() if trial in names}
    axes.plot([*crosses], [*crosses.values()], zorder=5, **_CROSS)
    if panel.best is not None:
        guide(axes, panel.best, f"paper:\nat best\n~{panel.best:g} %")
    for at, word in ((names.index(trial), word) for trial, word in panel.words.items() if trial in names):
        axes.axvspan(at - 0.5, at + 0.5, color="#f2efe6", zorder=0)
        axes.annotate(f"paper:\n{word}", (at, 1.0), xycoords=("data", "axes fraction"), fontsize=8, color="#555",
                      ha="center", va="bottom")  # fmt: skip
    return [*value_of.values(), *crosses.values()]
