"""Pictures of robots on impaired networks: over the trials, as in the paper's Figures 4.7 and 4.8, and over time."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from pebble.bench.impair import trials, wheels
from pebble.bench.judging.aims import single, with_lost
from pebble.bench.plots import Picture, Style, around, finite, guide, legend, log_axis, panels, short, styles, unique
from pebble.bench.results import OVER_TIME, Cell, Results, grouped

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
_NARROW, _WORST = f"aim\nat {trials.NARROW}", f"aim at\n{trials.WORST}"
_BANDS = ("#f3f0e7", "#ffffff")
_WIDE, _THIN = "#D55E00", "#0072B2"
_ROBOTS = {"wide": "robot of today", "thin": "profile thin", "auto": "profile auto"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """A line for each subject over the trials: a value of the cells whose measure begins with ``measure``."""

    label: str
    measure: str
    value: Callable[[Cell], float]  # not drawn if it is infinite
    log: bool = False
    aim: float | None = None  # drawn as a guide
    aim_text: str = ""
    crosses: Mapping[str, float] = field(default_factory=dict)  # the original's values by trial
    words: Mapping[str, str] = field(default_factory=dict)  # the paper's, by trial


def _drive(when: str) -> Panel:
    return Panel(label=f"drive p95\n{when.replace('during', 'with')}, ms", measure=f"drive {when}",
                 value=with_lost(95), log=True, aim=trials.WORST_DRIVE_P95_MS, aim_text=_WORST)  # fmt: skip


#: By name: the caption, the height of a panel in inches, and the panels.
_OVER_TRIALS: Final[dict[str, tuple[str, float, tuple[Panel, ...]]]] = {
    "audio-delivery": ("Audio delivery over the trials, in the form of the paper's Figure 4.7", 3.5, (
        Panel(label="audio that arrived, %", measure="audio", value=single("delivered_percent"),
              crosses=ORIGINAL["delivered_percent"], words=PAPER_WORDS,
              aim=PAPER_BEST_PERCENT, aim_text=f"paper:\nat best\n~{PAPER_BEST_PERCENT:g} %"),
        Panel(label="audio within 1 s, %", measure="audio", value=single("on_time_percent"),
              crosses=ORIGINAL["on_time_percent"]),
    )),
    "audio-latency": (
        "Latency of the audio that arrived, over the trials, in the form of the paper's Figure 4.8", 3.3, (
        Panel(label="audio latency p50, ms", measure="audio latency", value=trials.arrived(50), log=True),
        Panel(label="audio latency p95, ms", measure="audio latency", value=trials.arrived(95), log=True,
              crosses=ORIGINAL["p95_ms"], aim=trials.NARROW_SOUND_P95_MS, aim_text=_NARROW),
    )),
    "video": ("Video over the trials: frame rate, and how long it froze", 2.7, (
        Panel(label="pictures per second", measure="video", value=single("fps"), crosses=ORIGINAL["fps"]),
        Panel(label="frozen, s\n(gaps over 1 s)", measure="video", value=single("frozen_s")),
        Panel(label="longest gap, s", measure="video", value=single("longest_gap_s"), log=True,
              aim=trials.NARROW_PICTURE_GAP_S, aim_text=_NARROW),
    )),
    "drive": ("Drive commands and heartbeat over the trials (no point: more than 5 % of the commands were lost)", 2.3, (
        _drive("alone"), _drive("during video"), _drive("during audio"),
        Panel(label="robot seen offline,\nlongest, s", measure="heartbeat", value=single("longest_offline_s"),
              aim=trials.WORST_OFFLINE_S, aim_text=_WORST),
    )),
}  # fmt: skip


def over_trials(results: Results) -> list[Picture]:
    """Audio, video and commands over the trials."""
    cells = [cell for cell in results.cells if "trial" in cell.params]
    run = (
        f"; windows of {results.options.get('window_s', 0):g} s. “original”: this program with the original's encodings"
    )
    return [
        Picture(f"{results.bench}-{name}", caption + run, partial(_trials, cells, caption + run, height, shown))
        for name, (caption, height, shown) in _OVER_TRIALS.items()
        if cells
    ]


def _trials(cells: Sequence[Cell], title: str, height: float, shown: Sequence[Panel]) -> Figure:
    """Logarithmic panels have one scale, to show waiting behind media."""
    figure, every = panels(len(shown), 1, (10.5, height), title)
    names = unique([str(cell.params["trial"]) for cell in cells])
    style_of = styles(unique([cell.variant for cell in cells]))
    seen = [_lines(axes, cells, names, style_of, panel) for axes, panel in zip(every, shown, strict=True)]
    ends = around([one for panel, values in zip(shown, seen, strict=True) if panel.log for one in values])
    for axes, panel, values in zip(every, shown, seen, strict=True):
        top = max([*finite(values), 1.0])
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
) -> list[float | None]:
    """Draws one line per subject, and the references; returns all values."""
    value_of: dict[tuple[str, str], float] = {}
    for cell in cells:
        if cell.measure.startswith(panel.measure) and math.isfinite(value := panel.value(cell)):
            value_of.setdefault((cell.variant, str(cell.params["trial"])), value)
    for number, (subject, style) in enumerate(style_of.items()):
        beside = 0.06 * (number - (len(style_of) - 1) / 2)  # keeps equal values visible
        axes.plot(
            np.arange(len(names)) + beside, [value_of.get((subject, trial), math.nan) for trial in names],
            color=style.colour, linestyle=style.dash, marker=style.marker,
            markersize=5, linewidth=1.2, markerfacecolor="white" if style.hollow else style.colour,
        )  # fmt: skip
    crosses = {names.index(trial): value for trial, value in panel.crosses.items() if trial in names}
    axes.plot([*crosses], [*crosses.values()], zorder=5, **_CROSS)
    if panel.aim is not None:
        guide(axes, panel.aim, panel.aim_text)
    for at, word in ((names.index(trial), word) for trial, word in panel.words.items() if trial in names):
        axes.axvspan(at - 0.5, at + 0.5, color="#f2efe6", zorder=0)
        axes.annotate(f"paper:\n{word}", (at, 1.0), xycoords=("data", "axes fraction"), fontsize=8, color="#555",
                      ha="center", va="bottom")  # fmt: skip
    return [*value_of.values(), *crosses.values(), panel.aim]


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
    ends = around([latency for cell in cells for latency in cell.rounds[1]])
    last = max(second for cell in cells for second in finite(cell.rounds[0]))
    marked = [*marks(str(results.options.get("marks", ""))), ("", last)]
    for axes, cell in zip(every, cells, strict=True):
        for number, ((name, begin), (_, until)) in enumerate(pairwise(marked)):
            axes.axvspan(begin, until, color=_BANDS[number % 2], zorder=0)
            if axes is every[0]:
                axes.annotate(name, ((begin + until) / 2, 1.02), xycoords=("data", "axes fraction"), fontsize=8,
                              color="#333", rotation=40, rotation_mode="anchor")  # fmt: skip
        axes.plot(*cell.rounds, ".", color=style_of[cell.variant].colour, markersize=2.2, antialiased=False)
        axes.set_xlim(-0.01 * last, 1.01 * last)
        log_axis(axes, "y", f"{short(cell.variant, 18)}\nlatency, ms", *ends)
    every[-1].set_xlabel("seconds since the first trial began")
    return figure


# -- what the wheels did


def what_the_wheels_did(results: Results) -> list[Picture]:
    """One picture for each trial: the speed that was commanded, and that of the wheels, a panel for each robot."""
    found = []
    curves = [one for one in results.cells if one.measure.endswith(OVER_TIME) and len(one.rounds) == 2]
    for trial, shown in grouped(curves, lambda cell: str(cell.params.get("trial", ""))).items():
        robots = grouped(shown, lambda cell: cell.variant)
        known = {name: {one.measure: one for one in cells} for name, cells in robots.items()}
        link = trial.removeprefix("thin-")
        caption = f"What the wheels did over {link}: commanded, and obeyed"
        name = re.sub("[^a-z0-9]+", "-", f"{results.bench}-wheels-{link}".removesuffix("%"))
        found.append(Picture(name, caption, partial(_wheels, known, caption)))
    return found


def _wheels(robots: Mapping[str, Mapping[str, Cell]], title: str) -> Figure:
    figure, every = panels(len(robots), 1, (11.0, 1.9), title)
    last = max(max(cells[wheels.COMMANDED].rounds[0]) for cells in robots.values())
    for axes, (name, cells) in zip(every, robots.items(), strict=True):
        commanded, moved = cells[wheels.COMMANDED], cells[wheels.WHEELS]
        axes.fill_between(
            moved.rounds[0],
            moved.rounds[1],
            step="post",
            color=_WIDE if name == "wide" else _THIN,
            alpha=0.75,
            linewidth=0,
        )
        axes.step(commanded.rounds[0], commanded.rounds[1], where="post", color="#1a1a1a", linewidth=1.0)
        for measure, colour, text in ((wheels.RELEASED, "#555", "let go"), (wheels.STOPPED, "#A4133C", "STOP")):
            for at in cells[measure].rounds[0] if measure in cells else ():
                axes.axvline(at, color=colour, linewidth=1.6 if text == "STOP" else 1.0, linestyle=(0, (3, 2)))
                axes.annotate(text, (at, 1.0), xycoords=("data", "axes fraction"), xytext=(3, -2), fontsize=8,
                              textcoords="offset points", color=colour, va="top",
                              weight="bold" if text == "STOP" else "normal")  # fmt: skip
        if not any(moved.rounds[1]):
            axes.annotate("the wheels never turned", (0.5, 0.5), xycoords="axes fraction", fontsize=11, color="#A4133C",
                          ha="center", weight="bold", backgroundcolor="white")  # fmt: skip
        axes.set(xlim=(0, last), ylim=(0, 1.15), ylabel=f"{_ROBOTS.get(name, name)}\nspeed")
        axes.set_yticks([0, 0.5, 1])
        axes.grid(visible=False, axis="x")
    every[-1].set_xlabel("seconds")
    handles = [
        Line2D([], [], color="#1a1a1a", linewidth=1.0, label="commanded"),
        Line2D([], [], color=_WIDE, linewidth=6, alpha=0.75, label="what the wheels did, robot of today"),
        Line2D([], [], color=_THIN, linewidth=6, alpha=0.75, label="what the wheels did, with a link profile"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)
    return figure
