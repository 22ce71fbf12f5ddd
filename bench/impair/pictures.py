"""Pictures of robots on impaired networks: over the trials, as in the paper's Figures 4.7 and 4.8, and over time."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from pebble.bench import paper
from pebble.bench.aims import single, with_lost
from pebble.bench.impair.trials import arrived
from pebble.bench.plots import Picture, Style, around, finite, guide, legend, log_axis, panels, short, styles, unique
from pebble.bench.results import OVER_TIME, Cell, Results, grouped

_QUOTED = Line2D([], [], color="#1a1a1a", marker="x", linestyle="", markersize=7, markeredgewidth=2,
                 label="the original program itself, measured once elsewhere")  # fmt: skip
_NARROW, _WORST = f"aim\nat {paper.NARROW}", f"aim at\n{paper.WORST}"
_BANDS = ("#f3f0e7", "#ffffff")


def _original(value: Callable[[paper.Original], float | None], factor: float = 1.0) -> dict[str, float]:
    """The original's values by trial, as far as they were measured."""
    return {trial: factor * known for trial, one in paper.ORIGINAL.items() if (known := value(one)) is not None}


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """A line for each subject over the trials: a value of the cells whose measures begin with ``measures``."""

    label: str
    measures: tuple[str, ...]
    value: Callable[[Cell], float]  # not drawn if it is infinite
    log: bool = False
    ends: tuple[float, float] | None = None  # of a linear axis; None: from 0 to the largest value
    aim: float | None = None  # drawn as a guide
    aim_text: str = ""
    crosses: Mapping[str, float] = field(default_factory=dict)  # the original's values by trial
    words: Mapping[str, str] = field(default_factory=dict)  # the paper's, by trial


def _drive(what: str) -> Panel:
    label = f"drive p95\n{what.replace('during', 'with')}, ms"
    return Panel(label=label, measures=(f"drive {what}",), value=with_lost(95), log=True,
                 aim=paper.WORST_DRIVE_P95_MS, aim_text=_WORST)  # fmt: skip


_FRAMES: Final = ("video", "picture")
#: By name: the caption, the height of a panel in inches, and the panels.
_OVER_TRIALS: Final[dict[str, tuple[str, float, tuple[Panel, ...]]]] = {
    "audio-delivery": ("Audio delivery over the trials, in the form of the paper's Figure 4.7", 3.5, (
        Panel(label="audio that arrived, %", measures=("audio",), value=single("delivered_percent"), ends=(-4, 106),
              crosses=_original(lambda one: one.delivered_percent), aim=paper.PAPER_BEST_PERCENT,
              aim_text=f"paper:\nat best\n~{paper.PAPER_BEST_PERCENT:g} %", words=paper.PAPER_WORDS),
        Panel(label="audio within 1 s, %", measures=("audio",), value=single("on_time_percent"), ends=(-4, 106),
              crosses=_original(lambda one: one.on_time_percent)),
    )),
    "audio-latency": (
        "Latency of the audio that arrived, over the trials, in the form of the paper's Figure 4.8", 3.3, (
        Panel(label="audio latency p50, ms", measures=("audio latency",), value=arrived(50), log=True),
        Panel(label="audio latency p95, ms", measures=("audio latency",), value=arrived(95), log=True,
              crosses=_original(lambda one: one.p95_s, 1000.0), aim=paper.NARROW_SOUND_P95_MS, aim_text=_NARROW),
    )),
    "video": ("Video over the trials: frame rate, and how long it froze", 2.7, (
        Panel(label="pictures per second", measures=_FRAMES, value=single("fps"),
              crosses=_original(lambda one: one.fps)),
        Panel(label="frozen, s\n(gaps over 1 s)", measures=_FRAMES, value=single("frozen_s")),
        Panel(label="longest gap, s", measures=_FRAMES, value=single("longest_gap_s"), log=True,
              aim=paper.NARROW_PICTURE_GAP_S, aim_text=_NARROW),
    )),
    "drive": ("Drive commands and heartbeat over the trials (no point: more than 5 % of the commands were lost)", 2.3, (
        _drive("alone"), _drive("during video"), _drive("during audio"),
        Panel(label="robot seen offline,\nlongest, s", measures=("heartbeat",), value=single("longest_offline_s"),
              aim=paper.WORST_OFFLINE_S, aim_text=_WORST),
    )),
}  # fmt: skip


def over_trials(results: Results) -> list[Picture]:
    """Audio, video and commands over the trials."""
    cells = [cell for cell in results.cells if "trial" in cell.params]
    if not cells:
        return []
    options = results.options
    run = f"; windows of {options.get('window_s', 0):g} s, over {options.get('link_words')}. “original”: this program "
    run += "with the original's encodings"
    return [
        Picture(f"{results.bench}-{name}", caption + run, partial(_trials, cells, caption + run, height, shown))
        for name, (caption, height, shown) in _OVER_TRIALS.items()
    ]


def _trials(cells: Sequence[Cell], title: str, height: float, shown: Sequence[Panel]) -> Figure:
    figure, every = panels(len(shown), 1, (10.5, height), title)
    trials = unique([str(cell.params["trial"]) for cell in cells])
    style_of = styles(unique([cell.variant for cell in cells]))
    seen = [_lines(axes, cells, trials, style_of, panel) for axes, panel in zip(every, shown, strict=True)]
    for axes, panel, values in zip(every, shown, seen, strict=True):
        if panel.log:  # panels with the same aim have one scale, to show waiting behind media
            same = [one for other, found in zip(shown, seen, strict=True) for one in found if other.aim == panel.aim]
            log_axis(axes, "y", panel.label, *around([*(same if panel.aim else values), panel.aim]))
        else:
            axes.set_ylim(*(panel.ends or (-0.1, 1.15 * max(finite([*values, panel.aim, 1.0])))))
            axes.set_ylabel(panel.label)
        if panel.aim is not None:
            guide(axes, panel.aim, panel.aim_text)
        for at, word in ((trials.index(trial), word) for trial, word in panel.words.items() if trial in trials):
            axes.axvspan(at - 0.5, at + 0.5, color="#f2efe6", zorder=0)
            axes.annotate(
                f"paper:\n{word}", (at, 1.0), xycoords=("data", "axes fraction"), fontsize=8, color="#555",
                ha="center", va="bottom",
            )  # fmt: skip
        axes.set_xlim(-0.6, len(trials) - 0.4)
        named = trials if axes is every[-1] else [""] * len(trials)
        axes.set_xticks(range(len(trials)), named, rotation=40, ha="right", rotation_mode="anchor")
    every[-1].set_xlabel("trial: condition of the network, in the order of the run")
    legend(figure, style_of, more=[_QUOTED] if any(panel.crosses for panel in shown) else [])
    return figure


def _lines(
    axes: Axes, cells: Sequence[Cell], trials: Sequence[str], style_of: Mapping[str, Style], panel: Panel
) -> list[float]:
    """Draws one line per subject; returns all values."""
    ours = [cell for cell in cells if cell.measure.startswith(panel.measures)]
    seen = list[float]()
    for number, (subject, style) in enumerate(style_of.items()):
        beside = 0.06 * (number - (len(style_of) - 1) / 2)  # keeps equal values visible
        heights = []
        for trial in trials:
            found = (panel.value(one) for one in ours if (one.variant, one.params["trial"]) == (subject, trial))
            heights.append(next(filter(math.isfinite, found), math.nan))
        seen += heights
        axes.plot(
            np.arange(len(trials)) + beside, heights, color=style.colour, linestyle=style.dash, marker=style.marker,
            markersize=5, linewidth=1.2, markerfacecolor="white" if style.hollow else style.colour,
        )  # fmt: skip
    for trial, height in panel.crosses.items():
        if trial in trials:
            seen.append(height)
            axes.plot(trials.index(trial), height, "x", color="#1a1a1a", markersize=7, markeredgewidth=2, zorder=5)
    return seen


# -- over time


def over_time(results: Results) -> list[Picture]:
    """One picture for each measure ``… over time``, whose cells hold two rounds: seconds, and milliseconds."""
    found = []
    curves = [one for one in results.cells if one.measure.endswith(OVER_TIME) and len(one.rounds) == 2]
    known = [curve for curve in curves if finite(curve.rounds[0])]
    for measure, shown in grouped(known, lambda cell: cell.measure).items():
        what = measure.removesuffix(OVER_TIME)
        caption = f"Latency of {what} over time, with the trials marked: a dot for each message that arrived"
        found.append(Picture(f"{results.bench}-{what}-over-time", caption, partial(_series, shown, results, caption)))
    return found


def marks(text: str) -> list[tuple[str, float]]:
    """Parses ``256k@37.2;512k@60`` into names and seconds."""
    found = (mark.partition("@") for mark in text.split(";") if mark)
    return [(name, float(second)) for name, _, second in found]


def _series(cells: Sequence[Cell], results: Results, title: str) -> Figure:
    figure, every = panels(len(cells), 1, (12.0, 2.1), title)
    style_of = styles([cell.variant for cell in cells])
    begun = marks(str(results.options.get("marks", "")))
    ends = around([latency for cell in cells for latency in cell.rounds[1]])
    last = max(second for cell in cells for second in finite(cell.rounds[0]))
    for axes, cell in zip(every, cells, strict=True):
        _bands(axes, begun, last, named=axes is every[0])
        axes.plot(*cell.rounds, ".", color=style_of[cell.variant].colour, markersize=2.2, antialiased=False)
        log_axis(axes, "y", f"{short(cell.variant, 18)}\nlatency, ms", *ends)
    every[-1].set_xlabel("seconds since the first trial began")
    return figure


def _bands(axes: Axes, found: Sequence[tuple[str, float]], end: float, *, named: bool) -> None:
    for number, ((name, begin), (_, until)) in enumerate(pairwise([*found, ("", end)])):
        axes.axvspan(begin, until, color=_BANDS[number % 2], zorder=0)
        axes.axvline(begin, color="#999", linewidth=0.6, zorder=1)
        if named:
            axes.annotate(
                name, ((begin + until) / 2, 1.02), xycoords=("data", "axes fraction"), fontsize=8, color="#333",
                ha="left", va="bottom", rotation=40, rotation_mode="anchor",
            )  # fmt: skip
    axes.set_xlim(-0.01 * end, 1.01 * end)
