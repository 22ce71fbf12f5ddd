"""Measures the operator page: what a driver feels, and what its server costs, beside the goals and the prototype.

A case is measured several times, each time with new robots, a new server and a new browser; the best time counts, and
the others are reported.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

from rich.table import Table

from pebble.bench import page_cases as cases
from pebble.bench.aims import outcome
from pebble.bench.comparison import Budget, Case, Comparison, Option
from pebble.bench.impair.conditions import Condition, Shape
from pebble.bench.page_rig import Rig, linked, rig
from pebble.bench.results import Cell, Judged, percentile
from pebble.bench.tables import figure, plain_table
from pebble.errors import PebbleError

IDLE_LOAD = 0.5  # of the machine, for figures that count
_LOAD_STEP_S = 5.0


class Goal(NamedTuple):
    """Bounds of the median and of the 95th percentile; ``at_least``: of the smallest instead. None: no goal."""

    p50: float | None = None
    p95: float | None = None
    at_least: float | None = None


class Row(NamedTuple):
    """One line of the table, by the key of its samples; ``prototype`` is what the design measured."""

    key: str
    unit: str
    goal: Goal = Goal()
    prototype: str = "–"


@dataclass(frozen=True, slots=True)
class PageCase:
    """Rows that are measured together."""

    name: str
    measure: Callable[[Rig, float], cases.Samples]
    rows: Sequence[Row]
    setting: Callable[[], AbstractContextManager[Rig]] = rig


#: Up is from the server to the page.
THIN = Condition("2 Mbit/s", up=Shape(kbit=2000))
FAR = Condition("256 kbit/s, 100 ms, 2 %", up=Shape(kbit=256, loss=0.02, delay_ms=50), down=Shape(delay_ms=50))

_GOOB = partial(rig, cases.ROBOT)
_STOP, _GONE, _SERVER = Goal(15, 60), Goal(None, 300), Goal(None, 450)
_PICTURES = {"json": "17 / 24", "pbvd": "14 / 18", "pbvz": "17 / 22", "h264": "13 / 20"}
_V, _R = f"{cases.VIEWERS} viewers", f"{cases.ROBOTS_SHOWN} robots"

CASES = (
    PageCase("keys", cases.keys, (
        Row("key to MQTT", "ms", Goal(2, 5), "0.93 / 1.35"),
        Row("key to motors", "ms", Goal(10, 20), "6.2 / 9.4"),
        Row("release to stop", "ms", _STOP, "7 / 18"),
    ), _GOOB),
    PageCase("interruptions", cases.interruptions, (
        Row("blur to stop", "ms", _STOP, "12"),
        Row("hidden to stop", "ms", _STOP, "48"),
        Row("frozen to stop", "ms", _GONE, "250"),
        Row("closed to stop", "ms", _GONE, "66"),
        Row("stalled to stop", "ms", _GONE, "252"),
        Row("server frozen to stop", "ms", _SERVER, "723"),
        Row("server killed to stop", "ms", _SERVER, "739"),
    ), _GOOB),
    PageCase("stops", cases.stops, (
        Row("STOP to motors", "ms", Goal(None, 50), "12-28"),
        Row("STOP to confirmed", "ms", Goal(None, 300)),
        Row("STOP ALL to motors", "ms", Goal(None, 150), "52-67"),
        Row("STOP ALL to confirmed", "ms", Goal(None, 300)),
    )),
    PageCase("pictures", cases.pictures, tuple(
        row
        for encoding, prototype in _PICTURES.items()
        for row in (
            Row(f"scene, {encoding} to drawn", "ms", Goal(25, 50), prototype),
            Row(f"scene, {encoding} lost", "%", Goal(0, 0), "0"),
        )
    ), partial(rig, cases.ROBOT, room=False)),  # pictures of the demo's room are up to 20 ms old when they are drawn
    PageCase("loading", cases.loading, (
        Row("first robot", "ms", Goal(None, 1000), "400-700"),
        Row("first picture", "ms", Goal(None, 3000), "1700-2500"),
    )),
    PageCase("files", cases.files, (
        Row("page, kB", "kB"),
        Row("page, kB gz", "kB", Goal(60), "14"),
        Row("with other screens, kB gz", "kB"),
        Row("requests", ""),
        Row("foreign hosts", "", Goal(0), "0"),
    ), _GOOB),
    PageCase("driving", cases.driving, (
        Row("1 viewer, driving: CPU", "%", Goal(8), "5.0"),
        Row("1 viewer, driving: RSS", "MB", Goal(60), "36"),
    ), _GOOB),
    PageCase("viewers", cases.viewers, (
        Row(f"{_V}: CPU", "%", Goal(25), "5.2"),
        Row(f"{_V}: RSS", "MB", Goal(80), "37"),
        Row("frames of each viewer", "%", Goal(at_least=95), "50"),
        Row("robot's uplink, of that with 1 viewer", "%", Goal(110)),
    ), _GOOB),
    PageCase("crowd", cases.crowd, (
        Row(f"{_R}: ms an update", "ms", Goal(8)),
        Row(f"{_R}: CPU", "%", Goal(10)),
        Row(f"{_R}: RSS", "MB", Goal(80)),
    ), partial(rig, "minilamp")),
    PageCase("thin link", cases.thin, (
        Row("2 Mbit/s: picture age", "ms", Goal(250), "183 / 209"),
        Row("2 Mbit/s: offered", "Mbit/s", Goal(at_least=3.8), "4.2"),
        Row("2 Mbit/s: drawn a second", ""),
    ), partial(linked, THIN, "minilamp")),
    PageCase("far link", cases.far, (
        Row("256 kbit/s: drive", "ms", Goal(None, 110)),
        Row("256 kbit/s: drive, arrived", "%"),
        Row("256 kbit/s: gestures interrupted", ""),
        Row("256 kbit/s: STOP to motors", "ms"),
        Row("256 kbit/s: round trip shown", "ms"),
    ), partial(linked, FAR, cases.ROBOT)),
)  # fmt: skip


ROWS = {row.key: row for case in CASES for row in case.rows}


def measure(case: Case) -> Iterator[Cell]:
    """One try. One that fails is noted, and its rows are empty."""
    run, name = case.run, str(case.condition["case"])
    about = next(one for one in CASES if one.name == name)

    def note(text: str, style: str = "") -> None:
        run.notes.append(f"{name}, try {case.number + 1}: {text}")
        run.console.print(run.notes[-1], style=style, highlight=False, markup=False)

    load = _idle(run["wait"])
    note(f"load {load:.2f}{'' if load < IDLE_LOAD else ', busy: read the figures as upper bounds'}")
    samples: cases.Samples = {}
    try:
        with about.setting() as made:
            samples = about.measure(made, run["scale"])
    except PebbleError as error:
        note(str(error), "red")
    for row in about.rows:
        yield case.cell(row.key, row.unit, samples.get(row.key, []))


def _idle(wait_s: float) -> float:
    """The load of the machine, once it is low or the time is over."""
    end = time.monotonic() + wait_s
    while (load := os.getloadavg()[0]) >= IDLE_LOAD and time.monotonic() < end:
        time.sleep(_LOAD_STEP_S)
    return load


# -- what is shown


def worst(row: Row, samples: Sequence[float]) -> float:
    """The figure by which tries are compared: smaller is better."""
    if row.goal.at_least is not None:
        return -min(samples)
    return percentile(samples, 50 if row.goal.p95 is None else 95)


def ranked(row: Row, tries: Sequence[Sequence[float]]) -> list[Sequence[float]]:
    """The tries that have samples, the best first."""
    return sorted((one for one in tries if one), key=lambda samples: worst(row, samples))


def met(goal: Goal, samples: Sequence[float]) -> bool | None:
    """Whether samples satisfy a goal; None: there is none, or nothing was measured."""
    if goal == Goal() or not samples:
        return None
    p50, p95 = (math.inf if bound is None else bound for bound in (goal.p50, goal.p95))
    least = -math.inf if goal.at_least is None else goal.at_least
    return min(samples) >= least and percentile(samples, 50) <= p50 and percentile(samples, 95) <= p95


def words(goal: Goal) -> str:
    """A goal for the table."""
    if goal.at_least is not None:
        return f"≥ {goal.at_least:g} each"
    if goal == Goal():
        return "–"
    return "≤ " + " / ".join("–" if bound is None else f"{bound:g}" for bound in (goal.p50, goal.p95))


def shown(goal: Goal, samples: Sequence[float], unit: str = "") -> str:
    """Median and 95th percentile, and the smallest if that is the goal; a single sample as it is."""
    if not samples:
        return "not measured"
    if len(samples) == 1:
        return f"{figure(samples[0])} {unit}".strip()
    low = f", least {figure(min(samples))}" if goal.at_least is not None else ""
    return f"{figure(percentile(samples, 50))} / {figure(percentile(samples, 95))}{low} {unit}".strip()


def _rows(cells: Sequence[Cell]) -> Iterator[tuple[Cell, Row, Sequence[float], Sequence[Sequence[float]]]]:
    """Each cell with its row, its best try and the others."""
    for cell in cells:
        row = ROWS[cell.measure]
        best, *others = ranked(row, cell.rounds) or [()]
        yield cell, row, best, others


def tables(cells: Sequence[Cell]) -> Iterator[Table]:
    """A line for each row: the best try, its goal, the prototype's figure, and the other tries."""
    heads = ["", "unit", "measured", "n", "goal", "", "prototype", "others"]
    table = plain_table("p50 / p95 of the best try", heads, left=2)
    last = None
    for cell, row, best, others in _rows(cells):
        if cell.params != last:
            table.add_section()
        state = {None: "", True: "met", False: "MISSED"}[met(row.goal, best)]
        rest = "; ".join(shown(row.goal, one) for one in others)
        figures = (shown(row.goal, best), str(len(best)), words(row.goal), state, row.prototype, rest)
        table.add_row(row.key, row.unit, *figures)
        last = cell.params
    yield table


def goals(cells: Sequence[Cell]) -> Iterator[Judged]:
    """The goals as aims, each judged by the best try."""
    for _, row, best, _ in _rows(cells):
        if row.goal != Goal():
            is_met = met(row.goal, best)
            yield Judged(
                what=f"{row.key}, p50 / p95 {words(row.goal)} {row.unit}".strip(),
                outcome=outcome(bool(is_met), judged=is_met is not None),
                measured=shown(row.goal, best, row.unit),
            )


def _is_complete(cells: Sequence[Cell]) -> bool:
    """Whether a try of each case has ended well."""
    measured = {cell.params["case"] for cell in cells if cell.samples}
    return all(cell.params["case"] in measured for cell in cells)


PAGE = Comparison(
    name="page",
    title="The operator page",
    what="What a driver feels in a browser, and what the page's server costs, beside the goals.",
    help="""The operator page in a browser: what a driver feels, and what its server costs.

    From a key to the motors of a simulated robot, from whatever interrupts a driver to their stop, from the camera to
    the screen; many viewers, many robots, slow links. Needs mosquitto and its clients, chromium, the extra dev, and
    root for the links.

    \b
        pebble bench page
        pebble bench page --quick --only keys,stops
    """,
    options=(
        Option(name="only", sets="cases", many=True, known=[case.name for case in CASES], metavar="NAMES",
               recorded=False, help="Some of the cases, separated by commas."),
        Option(name="tries", sets="rounds", kind=int, least=1, most=10_000,
               help="How often each case is measured; the best time counts."),
        Option(name="wait", kind=float, least=0, help="Seconds to wait, at most, for an idle machine."),
    ),
    full=Budget(1800, cases=[case.name for case in CASES], rounds=3, wait=0.0, scale=1.0),
    quick=Budget(300, rounds=1, scale=0.25),  # of the samples
    folder=Path("build/page"),
    variants=("page",),
    conditions=lambda run: [{"case": case.name} for case in CASES if case.name in run["cases"]],
    measure=measure,
    tables=(tables,),
    assessment=(goals,),
    complete=_is_complete,
    reported=None,
)  # fmt: skip
