"""Pictures of robots on impaired networks, as in the paper's Figures 4.7 and 4.8: trials from left to right."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from pebble.bench import paper
from pebble.bench.percentiles import percentile
from pebble.bench.plots_style import (
    Picture,
    around,
    finite,
    guide,
    legend,
    log_axis,
    panels,
    styles,
    unique,
)
from pebble.bench.results import OVER_TIME, Cell, Results

_QUOTED = Line2D([], [], color="#1a1a1a", marker="x", linestyle="", markersize=7, markeredgewidth=2,
                 label="the original program itself, measured once elsewhere")  # fmt: skip
_DRIVEN = {
    "drive alone": "drive p95\nalone, ms",
    "drive during video": "drive p95\nwith video, ms",
    "drive during audio": "drive p95\nwith audio, ms",
}
_NARROW, _WORST = f"aim\nat {paper.NARROW}", f"aim at\n{paper.WORST}"

Value = Callable[[str, str], float]  # of a subject in a trial


def over_trials(results: Results) -> list[Picture]:
    """Audio, video and commands over the trials."""
    if not _trials(results):
        return []
    made: list[tuple[str, str, Callable[[str], Figure]]] = [
        (
            "audio-delivery",
            "Audio delivery over the trials, in the form of the paper's Figure 4.7",
            lambda t: _audio(results, t),
        ),
        (
            "audio-latency",
            "Latency of the audio that arrived, over the trials, in the form of the paper's Figure 4.8",
            lambda t: _latency(results, t),
        ),
        ("video", "Video over the trials: frame rate, and how long it froze", lambda t: _video(results, t)),
        (
            "drive",
            "Drive commands and heartbeat over the trials (no point: more than 5 % of the commands were lost)",
            lambda t: _drive(results, t),
        ),
    ]
    return [
        _picture(f"{results.bench}-{name}", f"{caption}{_run_description(results)}", make)
        for name, caption, make in made
    ]


def _picture(name: str, caption: str, make: Callable[[str], Figure]) -> Picture:
    return Picture(name, caption, lambda: make(caption))


def _run_description(results: Results) -> str:
    """The part of the caption that describes windows and network."""
    options = results.options
    window = f"; windows of {options['window_s']:g} s" if "window_s" in options else ""
    link = f", over {options['link_words']}" if "link_words" in options else ""
    return f"{window}{link}. “original”: this program with the original's encodings"


def _original(value: Callable[[paper.Original], float | None]) -> dict[str, float]:
    """The original's values by trial, as far as they were measured."""
    return {trial: known for trial, one in paper.ORIGINAL.items() if (known := value(one)) is not None}


def _audio(results: Results, title: str) -> Figure:
    figure, (arrived, on_time) = panels(2, 1, (10.5, 3.5), title)
    for axes, name, crosses, label in (
        (arrived, "delivered_percent", _original(lambda one: one.delivered_percent), "audio that arrived, %"),
        (on_time, "on_time_percent", _original(lambda one: one.on_time_percent), "audio within 1 s, %"),
    ):
        _lines(axes, results, _figure(results, "audio", name), crosses)
        axes.set_ylabel(label)
        axes.set_ylim(-4, 106)
    guide(arrived, paper.PAPER_BEST_PERCENT, f"paper:\nat best\n~{paper.PAPER_BEST_PERCENT:g} %")
    for trial, word in paper.PAPER_WORDS.items():
        if trial in _trials(results):
            at = _trials(results).index(trial)
            arrived.axvspan(at - 0.5, at + 0.5, color="#f2efe6", zorder=0)
            arrived.annotate(
                f"paper:\n{word}", (at, 1.0), xycoords=("data", "axes fraction"), fontsize=8, color="#555",
                ha="center", va="bottom",
            )  # fmt: skip
    _names(figure, [arrived, on_time], results, [_QUOTED])
    return figure


def _latency(results: Results, title: str) -> Figure:
    figure, every = panels(2, 1, (10.5, 3.3), title)
    original_ms = {trial: 1000 * seconds for trial, seconds in _original(lambda one: one.p95_s).items()}
    for axes, percent, crosses in zip(every, (50, 95), ({}, original_ms), strict=True):
        seen = _lines(axes, results, _percentile(results, "audio latency", percent), crosses)
        log_axis(axes, "y", f"audio latency p{percent}, ms", *around([*seen, paper.NARROW_SOUND_P95_MS]))
    guide(every[1], paper.NARROW_SOUND_P95_MS, _NARROW)
    _names(figure, every, results, [_QUOTED])
    return figure


def _video(results: Results, title: str) -> Figure:
    figure, every = panels(3, 1, (10.5, 2.7), title)
    _lines(every[0], results, _figure(results, "video", "fps"), _original(lambda one: one.fps))
    every[0].set_ylabel("pictures per second")
    every[0].set_ylim(bottom=0)
    still = _lines(every[1], results, _figure(results, "video", "frozen_s"))
    every[1].set_ylim(-0.1, 1.15 * max(finite([*still, 1.0])))
    every[1].set_ylabel("frozen, s\n(gaps over 1 s)")
    seen = _lines(every[2], results, _figure(results, "video", "longest_gap_s"))
    log_axis(every[2], "y", "longest gap, s", *around([*seen, paper.NARROW_PICTURE_GAP_S]))
    guide(every[2], paper.NARROW_PICTURE_GAP_S, _NARROW)
    _names(figure, every, results, [_QUOTED])
    return figure


def _drive(results: Results, title: str) -> Figure:
    figure, every = panels(len(_DRIVEN) + 1, 1, (10.5, 2.3), title)
    seen = [
        _lines(axes, results, _percentile(results, measure, 95, lost=True))
        for axes, measure in zip(every, _DRIVEN, strict=False)
    ]
    for axes, label in zip(every, _DRIVEN.values(), strict=False):  # on one scale, to show waiting behind media
        log_axis(axes, "y", label, *around([*itertools.chain(*seen), paper.WORST_DRIVE_P95_MS]))
        guide(axes, paper.WORST_DRIVE_P95_MS, _WORST)
    spells = _lines(every[-1], results, _figure(results, "heartbeat", "longest_offline_s"))
    every[-1].set_ylabel("robot seen offline,\nlongest, s")
    every[-1].set_ylim(-0.1, 1.15 * max(finite([*spells, paper.WORST_OFFLINE_S])))
    guide(every[-1], paper.WORST_OFFLINE_S, _WORST)
    _names(figure, every, results)
    return figure


def _lines(axes: Axes, results: Results, value: Value, crosses: dict[str, float] | None = None) -> list[float]:
    """Draws one line per subject; returns all values."""
    trials = _trials(results)
    style_of = styles(_subjects(results))
    seen: list[float] = []
    for number, (subject, style) in enumerate(style_of.items()):
        beside = 0.06 * (number - (len(style_of) - 1) / 2)  # keeps equal values visible
        heights = [value(subject, trial) for trial in trials]
        seen += heights
        axes.plot(
            np.arange(len(trials)) + beside,
            heights,
            color=style.colour,
            linestyle=style.dash,
            marker=style.marker,
            markersize=5,
            linewidth=1.2,
            markerfacecolor="white" if style.hollow else style.colour,
        )
    for trial, height in (crosses or {}).items():
        if trial in trials:
            seen.append(height)
            axes.plot(trials.index(trial), height, "x", color="#1a1a1a", markersize=7, markeredgewidth=2, zorder=5)
    return seen


def _names(figure: Figure, every: Sequence[Axes], results: Results, more: Sequence[Line2D] = ()) -> None:
    trials = _trials(results)
    for axes in every:
        axes.set_xlim(-0.6, len(trials) - 0.4)
        axes.set_xticks(range(len(trials)), trials if axes is every[-1] else [""] * len(trials))
    every[-1].tick_params(axis="x", labelrotation=40)
    for label in every[-1].get_xticklabels():
        label.set_horizontalalignment("right")
        label.set_rotation_mode("anchor")
    every[-1].set_xlabel("trial: condition of the network, in the order of the run")
    legend(figure, styles(_subjects(results)), more=more)


def _of_trials(results: Results) -> list[Cell]:
    return [cell for cell in results.cells if "trial" in cell.params and not cell.measure.endswith(OVER_TIME)]


def _trials(results: Results) -> list[str]:
    return unique([str(cell.params["trial"]) for cell in _of_trials(results)])


def _subjects(results: Results) -> list[str]:
    return unique([cell.variant for cell in _of_trials(results)])


def _figure(results: Results, about: str, name: str) -> Value:
    """A single value of a cell about audio or video (its latency, or the gaps between pictures)."""
    kinds = (about, "picture") if about == "video" else (about,)

    def value(subject: str, trial: str) -> float:
        for cell in _of_trials(results):
            if (cell.variant, cell.params["trial"]) == (subject, trial) and cell.measure.startswith(kinds):
                found = cell.figures.get(name)
                if isinstance(found, int | float):
                    return float(found)
        return math.nan

    return value


def _percentile(results: Results, measure: str, percent: float, *, lost: bool = False) -> Value:
    """Percentile of what arrived, or with lost messages as infinitely late; not drawn if that is infinite."""

    def value(subject: str, trial: str) -> float:
        cell = results.find(subject, measure, trial=trial)
        if cell is None:
            return math.nan
        never = [math.inf] * max(0, cell.lost or 0) if lost else []
        found = percentile([*finite(cell.samples), *never], percent)
        return found if math.isfinite(found) else math.nan

    return value
