"""The tables and the assessment of the bridge comparison. Pure but for the printing."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rich.console import Console

from pebble.bench.aims import outcome
from pebble.bench.bridge_driven_robot import STAND_IN
from pebble.bench.bridge_one_hop import HOP
from pebble.bench.bridge_tally import DOWN, LOADED, UNLOADED, UP
from pebble.bench.ratios import LEAST_ROUNDS, paired
from pebble.bench.results import Cell, Judged, Value, percentile
from pebble.bench.tables import caveat, figure, latency_table, plain_table, sentence
from pebble.rig.robot import KINDS

AIMS_MS = {50: 0.7, 99: 2.0}
LEAST_SAMPLES = {50: 1, 99: 300}  # to assess an aim: with fewer, hardly any lie beyond that percentile
_LEAST_IN_ROUND = 100  # samples to compare p99 by rounds: with fewer it is the maximum
_LOSS_SHOWN = 0.005
WAYS = {DOWN: "command to the wheels", UP: "report to the operator"}
_FLOWS = {"frames_per_s": "frames/s", "video_per_s": "video/s", "audio_per_s": "audio/s"}


def show(cells: Sequence[Cell], console: Console) -> None:
    """Prints the latencies, then CPU and media rates of the same time."""
    ordered = sorted(cells, key=lambda cell: (list(WAYS).index(cell.measure), cell.params["load"] == LOADED))
    title = "Commands down, reports up; and the load on the robot"
    baseline = STAND_IN if any(cell.variant == STAND_IN for cell in cells) else KINDS[0]
    console.print(latency_table(title, ordered, baseline))
    cost = plain_table("Meanwhile", ["robot", "load", "CPU %", *_FLOWS.values()], left=2)
    for cell in ordered:
        if cell.measure == DOWN and cell.variant != HOP:
            flows = [_number(cell, name) for name in _FLOWS]
            cost.add_row(cell.variant, str(cell.params["load"]), _number(cell, "cpu_percent"), *flows)
    console.print(cost)


def assessment(cells: Sequence[Cell]) -> list[str | Judged]:
    """One sentence for each comparison, and one for each aim."""
    lines = [*_transports(cells), *_media(cells), *_floor(cells), *_lost(cells)]
    plain = [cell for way in WAYS for cell in _robots(cells, way, UNLOADED)]
    return [*lines, *caveat(plain), *(line for cell in plain for line in _aims(cell))]


def _transports(cells: Sequence[Cell]) -> list[str]:
    """Compares the robots' medians, then each with the stand-in."""
    lines = []
    for load in (UNLOADED, LOADED):
        for way, words in WAYS.items():
            what = f"Median, {words}{_media_suffix(load)}"
            if robots := _robots(cells, way, load):
                lines.append(sentence(what, robots, quantity="time"))
            lines += [
                sentence(what, [plain, one], quantity="time")
                for plain in _stand_ins(cells, way, load)
                for one in robots
            ]
    return lines


def _media(cells: Sequence[Cell]) -> list[str]:
    """Compares p99 with and without media."""
    lines = []
    for way, words in WAYS.items():
        for loaded in _robots(cells, way, LOADED):
            for free in _robots(cells, way, UNLOADED):
                if free.variant == loaded.variant:
                    lines.append(f"{free.variant}, {words}, p99: {_media_effect(loaded, free)}")
    return lines


def _media_effect(loaded: Cell, free: Cell) -> str:
    times = f"{figure(free.percentile(99))} ms, with media {figure(loaded.percentile(99))} ms"
    rounds = [*loaded.rounds, *free.rounds]
    if min(len(loaded.rounds), len(free.rounds)) < LEAST_ROUNDS or min(map(len, rounds)) < _LEAST_IN_ROUND:
        return times
    ratio = paired(loaded.rounds, free.rounds, 99)
    return f"{times}; {ratio.words('the robot with media', 'the one without')}"


def _floor(cells: Sequence[Cell]) -> list[str]:
    """The time a robot adds to one hop through a broker."""
    hop = next((cell for cell in cells if cell.variant == HOP), None)
    robots = _robots(cells, DOWN, UNLOADED)
    if hop is None or not hop.samples or not robots:
        return []
    more = ", ".join(f"{cell.variant} {figure(cell.percentile(50) - hop.percentile(50))} ms more" for cell in robots)
    floor = f"{figure(hop.percentile(50))} ms"
    return [f"One hop, operator to a stock client through a broker of their own, takes {floor}; {more}."]


def _lost(cells: Sequence[Cell]) -> list[str]:
    """Reports losses above a threshold."""
    lines = []
    for cell in cells:
        lost, sent = cell.lost or 0, len(cell.samples) + (cell.lost or 0)
        if lost > _LOSS_SHOWN * sent:
            what = f"{cell.variant}, {WAYS[cell.measure]}{_media_suffix(cell.params['load'])}"
            lines.append(f"{what}: {100 * lost / sent:.1f} % of {sent} were overtaken, or did not arrive within 1 s.")
    return lines


def _media_suffix(load: Value) -> str:
    return ", media flowing" if load == LOADED else ""


def _aims(cell: Cell) -> list[Judged]:
    """Compares p50 and p99 with the aims; what did not arrive counts as infinitely late."""
    found = []
    for percent, aim in AIMS_MS.items():
        times = [*cell.samples, *[math.inf] * (cell.lost or 0)]
        judged = len(cell.rounds) >= LEAST_ROUNDS and len(times) >= LEAST_SAMPLES[percent]
        took = percentile(times, percent)
        what = f"{cell.variant}, {WAYS[cell.measure]}, p{percent} at most {aim:g} ms"
        took_text = "not within 1 s" if math.isinf(took) else f"{figure(took)} ms"
        if judged and aim < took < math.inf:
            took_text += f", by {took - aim:.2f} ms"
        found.append(Judged(what=what, outcome=outcome(took <= aim, judged=judged), measured=took_text))
    return found


def _robots(cells: Sequence[Cell], measure: str, load: str) -> list[Cell]:
    found = [cell for cell in cells if (cell.measure, cell.params["load"]) == (measure, load) and cell.variant in KINDS]
    return sorted(found, key=lambda cell: KINDS.index(cell.variant))


def _stand_ins(cells: Sequence[Cell], measure: str, load: str) -> list[Cell]:
    """The stand-in's cell, if it was measured."""
    found = (cell for cell in cells if cell.variant == STAND_IN and cell.samples)
    return [cell for cell in found if (cell.measure, cell.params["load"]) == (measure, load)]


def _number(cell: Cell, name: str) -> str:
    value = cell.figures.get(name)
    return f"{value:.1f}" if isinstance(value, float) else ""
