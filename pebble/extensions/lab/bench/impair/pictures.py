"""Charts of robots on impaired networks, over the trials as in the paper's Figures 4.7 and 4.8."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Final

from pebble.extensions.lab.bench.impair import metrics
from pebble.extensions.lab.bench.plots import Style, guide, legend, log_axis, log_limits, panels, styles
from pebble.extensions.lab.bench.results import Cell
from pebble.extensions.lab.bench.show import Picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: % of the audio delivered, "saturated near" (paper, section 4.2).
PAPER_BEST_PERCENT: Final = 80.0
PAPER_WORDS: Final = {"512k": "degraded", "256k": "broken"}
#: Results of the original program by trial, measured once, elsewhere, through such a network.
DELIVERED: Final = {"256k": 40.0, "64k": 5.7}  # % of the audio
ON_TIME: Final = {"256k": 3.5}  # %, within a second
P95_MS: Final = {"256k": 6900.0}  # latency of the audio
_CROSS: Final[Style] = {"color": "#1a1a1a", "marker": "x", "linestyle": "", "markersize": 7, "markeredgewidth": 2}


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """A chart with a line per subject over the trials: a percentile of a measure, not drawn where it is infinite."""

    label: str
    measure: str
    percent: int = 50
    log: bool = False
    crosses: Mapping[str, float] = field(default_factory=dict)  # the original's values by trial
    words: Mapping[str, str] = field(default_factory=dict)  # the paper's, by trial
    best: float | None = None  # the paper's best value


_DELIVERY: Final = (
    Panel(label="audio that arrived, %", measure=metrics.DELIVERED, crosses=DELIVERED, words=PAPER_WORDS,
          best=PAPER_BEST_PERCENT),
    Panel(label="audio within 1 s, %", measure=metrics.ON_TIME, crosses=ON_TIME),
)  # fmt: skip
_LATENCY: Final = (
    Panel(label="audio latency p50, ms", measure=metrics.SOUND, log=True),
    Panel(label="audio latency p95, ms", measure=metrics.SOUND, percent=95, log=True, crosses=P95_MS),
)


def over_trials(cells: Sequence[Cell], more: str) -> list[Picture]:
    """Return charts of delivery and latency of audio over the trials; ``more`` is added to their captions."""
    form = "over the trials, in the form of the paper's Figure"
    captions = {
        "audio-delivery": (f"Audio delivery {form} 4.7; {more}", _DELIVERY),
        "audio-latency": (f"Latency of the audio that arrived, {form} 4.8; {more}", _LATENCY),
    }
    return [
        Picture(f"impair-{name}", caption, partial(_draw_trials, cells, caption, shown))
        for name, (caption, shown) in captions.items()
    ]


def _draw_trials(cells: Sequence[Cell], title: str, shown_panels: Sequence[Panel]) -> Figure:
    """Return a figure with all panels; logarithmic ones have one scale."""
    figure, all_axes = panels(len(shown_panels), 1, (10.5, 3.4), title)
    names = list(dict.fromkeys(str(cell.params["trial"]) for cell in cells))
    style_of = styles([cell.variant for cell in cells])
    drawn_values = [
        _draw_lines(axes, cells, names, style_of, panel) for axes, panel in zip(all_axes, shown_panels, strict=True)
    ]
    log_values = []
    for panel, values in zip(shown_panels, drawn_values, strict=True):
        log_values += values if panel.log else []
    for axes, panel, values in zip(all_axes, shown_panels, drawn_values, strict=True):
        top = max([*values, 1.0])
        if panel.log:
            log_axis(axes, "y", panel.label, *log_limits(log_values))
        else:
            axes.set(ylabel=panel.label, ylim=(-0.04 * top, 1.1 * top))
        axes.set_xlim(-0.6, len(names) - 0.4)
        axes.set_xticks(range(len(names)), [])
    all_axes[-1].set_xticks(range(len(names)), names, rotation=40, ha="right", rotation_mode="anchor")
    all_axes[-1].set_xlabel("trial: condition of the network, in the order of the run")
    legend(figure, {**style_of, "the original program itself, measured once elsewhere": _CROSS})
    return figure


def _draw_lines(
    axes: Axes, cells: Sequence[Cell], names: Sequence[str], style_of: Mapping[str, Style], panel: Panel
) -> list[float]:
    """Draw a line per variant of the robot, the original's values and the paper's words; return the values."""
    value_of = {}  # by subject and trial
    for cell in cells:
        value = cell.percentile(panel.percent)
        if cell.measure == panel.measure and math.isfinite(value):
            value_of[cell.variant, str(cell.params["trial"])] = value
    for number, (subject, style) in enumerate(style_of.items()):
        shift = 0.06 * (number - (len(style_of) - 1) / 2)  # keeps equal values of several subjects visible
        values = [value_of.get((subject, trial), math.nan) for trial in names]
        axes.plot([at + shift for at in range(len(names))], values, linewidth=1.2, **style)
    crosses = {names.index(trial): value for trial, value in panel.crosses.items() if trial in names}
    axes.plot([*crosses], [*crosses.values()], zorder=5, **_CROSS)
    if panel.best is not None:
        guide(axes, panel.best, f"paper:\nat best\n~{panel.best:g} %")
    for trial, word in panel.words.items():
        if trial not in names:
            continue
        at = names.index(trial)
        axes.axvspan(at - 0.5, at + 0.5, color="#f2efe6", zorder=0)
        axes.annotate(f"paper:\n{word}", (at, 1.0), xycoords=("data", "axes fraction"), fontsize=8, color="#555",
                      ha="center", va="bottom")  # fmt: skip
    return [*value_of.values(), *crosses.values()]
