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
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.table import Table

from pebble.bench import page_cases as cases
from pebble.bench import page_links as links
from pebble.bench.engine import check_folder
from pebble.bench.page_rig import Rig, rig
from pebble.bench.results import Cell, Results, Stopwatch, percentile
from pebble.bench.tables import figure, plain_table
from pebble.errors import PebbleError
from pebble.runtime.signals import interrupted_by_signals

FOLDER = Path("build/page")
IDLE_LOAD = 0.5  # of the machine, for figures that count
TRIES = 3
_QUICK = 0.25  # of the samples
_LOAD_STEP_S = 5.0


class Goal(NamedTuple):
    """Bounds of the median and of the 95th percentile; ``at_least``: of the smallest instead. None: no goal."""

    p50: float | None = None
    p95: float | None = None
    at_least: float | None = None


NO_GOAL = Goal()


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table, by the key of its samples; ``prototype`` is what the design measured."""

    key: str
    unit: str
    goal: Goal = NO_GOAL
    prototype: str = "–"


@dataclass(frozen=True, slots=True)
class Case:
    """Rows that are measured together."""

    name: str
    measure: Callable[[Rig, float], cases.Samples]
    rows: Sequence[Row]
    setting: Callable[[], AbstractContextManager[Rig]] = rig


def _thin() -> AbstractContextManager[Rig]:
    return links.linked(links.THIN, "minilamp", wide=True)


def _far() -> AbstractContextManager[Rig]:
    return links.linked(links.FAR, cases.ROBOT)


def _lamp() -> AbstractContextManager[Rig]:
    return rig("minilamp")


def _goob() -> AbstractContextManager[Rig]:
    return rig(cases.ROBOT)


def _goob_alone() -> AbstractContextManager[Rig]:
    """Its pictures are as old as they look: those of the demo's room are up to 20 ms old when they are drawn."""
    return rig(cases.ROBOT, room=False)


_STOP, _GONE, _SERVER = Goal(15, 60), Goal(None, 300), Goal(None, 450)
_PICTURES = {"json": "17 / 24", "pbvd": "14 / 18", "pbvz": "17 / 22", "h264": "13 / 20"}
_V, _R = f"{cases.VIEWERS} viewers", f"{cases.ROBOTS_SHOWN} robots"

CASES = (
    Case("keys", cases.keys, (
        Row("key to MQTT", "ms", Goal(2, 5), "0.93 / 1.35"),
        Row("key to motors", "ms", Goal(10, 20), "6.2 / 9.4"),
        Row("release to stop", "ms", _STOP, "7 / 18"),
    ), _goob),
    Case("interruptions", cases.interruptions, (
        Row("blur to stop", "ms", _STOP, "12"),
        Row("hidden to stop", "ms", _STOP, "48"),
        Row("frozen to stop", "ms", _GONE, "250"),
        Row("closed to stop", "ms", _GONE, "66"),
        Row("stalled to stop", "ms", _GONE, "252"),
        Row("server frozen to stop", "ms", _SERVER, "723"),
        Row("server killed to stop", "ms", _SERVER, "739"),
    ), _goob),
    Case("stops", cases.stops, (
        Row("STOP to motors", "ms", Goal(None, 50), "12-28"),
        Row("STOP to confirmed", "ms", Goal(None, 300)),
        Row("STOP ALL to motors", "ms", Goal(None, 150), "52-67"),
        Row("STOP ALL to confirmed", "ms", Goal(None, 300)),
    )),
    Case("pictures", cases.pictures, tuple(
        row
        for encoding, prototype in _PICTURES.items()
        for row in (
            Row(f"scene, {encoding} to drawn", "ms", Goal(25, 50), prototype),
            Row(f"scene, {encoding} lost", "%", Goal(0, 0), "0"),
        )
    ), _goob_alone),
    Case("loading", cases.loading, (
        Row("first robot", "ms", Goal(None, 1000), "400-700"),
        Row("first picture", "ms", Goal(None, 3000), "1700-2500"),
    )),
    Case("files", cases.files, (
        Row("page, kB", "kB"),
        Row("page, kB gz", "kB", Goal(60), "14"),
        Row("with other screens, kB gz", "kB"),
        Row("requests", ""),
        Row("foreign hosts", "", Goal(0), "0"),
    ), _goob),
    Case("driving", cases.driving, (
        Row("1 viewer, driving: CPU", "%", Goal(8), "5.0"),
        Row("1 viewer, driving: RSS", "MB", Goal(60), "36"),
    ), _goob),
    Case("viewers", cases.viewers, (
        Row(f"{_V}: CPU", "%", Goal(25), "5.2"),
        Row(f"{_V}: RSS", "MB", Goal(80), "37"),
        Row("frames of each viewer", "%", Goal(at_least=95), "50"),
        Row("robot's uplink, of that with 1 viewer", "%", Goal(110)),
    ), _goob),
    Case("crowd", cases.crowd, (
        Row(f"{_R}: ms an update", "ms", Goal(8)),
        Row(f"{_R}: CPU", "%", Goal(10)),
        Row(f"{_R}: RSS", "MB", Goal(80)),
    ), _lamp),
    Case("thin link", links.pictures, (
        Row("2 Mbit/s: picture age", "ms", Goal(250), "183 / 209"),
        Row("2 Mbit/s: offered", "Mbit/s", Goal(at_least=3.8), "4.2"),
        Row("2 Mbit/s: drawn a second", ""),
    ), _thin),
    Case("far link", links.driving, (
        Row("256 kbit/s: drive", "ms", Goal(None, 110)),
        Row("256 kbit/s: drive, arrived", "%"),
        Row("256 kbit/s: gestures interrupted", ""),
        Row("256 kbit/s: STOP to motors", "ms"),
        Row("256 kbit/s: round trip shown", "ms"),
    ), _far),
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class PagePlan:
    """The options of a run."""

    only: Sequence[str] = ()  # names of cases; none: all
    tries: int = TRIES
    quick: bool = False  # one try with fewer samples
    wait_s: float = 0.0  # at most, for an idle machine, before each try
    output: Path = FOLDER

    def check(self) -> None:
        """Raises PebbleError naming an invalid option."""
        unknown = set(self.only) - {case.name for case in CASES}
        if unknown:
            raise PebbleError(f"no case {min(unknown)!r}: choose from {', '.join(case.name for case in CASES)}")
        check_folder(self.output)

    def chosen(self) -> list[Case]:
        return [case for case in CASES if not self.only or case.name in self.only]

    def command(self) -> list[str]:
        """The command line that repeats the run."""
        only = ["--only", ",".join(self.only)] if self.only else []
        return ["pebble", "bench", "page", *only, *(["--quick"] if self.quick else ["--tries", str(self.tries)])]


@dataclass(slots=True)
class Tried:
    """The samples of one case: of each try, with the load of the machine before it."""

    case: Case
    loads: list[float] = field(default_factory=list)
    tries: list[cases.Samples] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


def run(plan: PagePlan, console: Console | None = None) -> int:
    """Measures, prints and writes; returns 0 if every case has results. Raises PebbleError for invalid options."""
    console = console or Console()
    plan.check()
    watch = Stopwatch("page", plan.command(), {"tries": plan.tries, "quick": plan.quick})
    done: list[Tried] = []
    with interrupted_by_signals():
        for case in plan.chosen():
            done.append(_tried(case, plan, console))
            console.print(table([done[-1]]))
    _write(
        watch.results([cell for one in done for cell in cells_of(one)], _notes(done), quick=plan.quick), plan, console
    )
    return int(any(not one.tries for one in done))


def _tried(case: Case, plan: PagePlan, console: Console) -> Tried:
    tried = Tried(case)
    for number in range(1 if plan.quick else plan.tries):
        load = _idle(plan.wait_s)
        busy = "" if load < IDLE_LOAD else ", busy: read the figures as upper bounds"
        console.print(f"{case.name}, try {number + 1}: load {load:.2f}{busy}", highlight=False)
        try:
            with case.setting() as made:
                tried.tries.append(case.measure(made, _QUICK if plan.quick else 1.0))
            tried.loads.append(load)
        except PebbleError as error:
            tried.problems.append(str(error))
            console.print(f"{case.name}: {error}", style="red", highlight=False, markup=False)
    return tried


def _idle(wait_s: float) -> float:
    """The load of the machine, once it is low or the time is over."""
    end = time.monotonic() + wait_s
    while os.getloadavg()[0] >= IDLE_LOAD and time.monotonic() < end:
        time.sleep(_LOAD_STEP_S)
    return os.getloadavg()[0]


# -- pure


def worst(row: Row, samples: Sequence[float]) -> float:
    """The figure by which tries are compared: smaller is better."""
    if not samples:
        return math.inf
    if row.goal.at_least is not None:
        return -min(samples)
    return percentile(samples, 50 if row.goal.p95 is None else 95)


def ranked(row: Row, tries: Sequence[Sequence[float]]) -> list[Sequence[float]]:
    """The tries that have samples, the best first."""
    return sorted((one for one in tries if one), key=lambda samples: worst(row, samples))


def met(goal: Goal, samples: Sequence[float]) -> bool | None:
    """Whether samples satisfy a goal; None: there is none."""
    if goal == NO_GOAL:
        return None
    bounds = [(goal.p50, percentile(samples, 50)), (goal.p95, percentile(samples, 95))]
    return (goal.at_least is None or min(samples) >= goal.at_least) and all(
        bound is None or value <= bound for bound, value in bounds
    )


def words(goal: Goal) -> str:
    """A goal for the table."""
    if goal.at_least is not None:
        return f"≥ {goal.at_least:g} each"
    bounds = ["–" if bound is None else f"{bound:g}" for bound in (goal.p50, goal.p95)]
    return "–" if bounds == ["–", "–"] else f"≤ {' / '.join(bounds)}"


def shown(goal: Goal, samples: Sequence[float]) -> str:
    """Median and 95th percentile, or the smallest; a single sample as it is."""
    if len(samples) == 1:
        return figure(samples[0])
    low = f", least {figure(min(samples))}" if goal.at_least is not None else ""
    return f"{figure(percentile(samples, 50))} / {figure(percentile(samples, 95))}{low}"


def table(done: Sequence[Tried]) -> Table:
    """A line for each row: the best try, its goal, the prototype's figure, and the other tries."""
    rows = plain_table(
        "p50 / p95 of the best try", ["", "unit", "measured", "n", "goal", "", "prototype", "others"], left=2
    )
    for tried in done:
        for row in tried.case.rows:
            best, *others = ranked(row, [one.get(row.key, []) for one in tried.tries]) or [()]
            state = {None: "", True: "met", False: "MISSED"}[met(row.goal, best) if best else None]
            measured = shown(row.goal, best) if best else "not measured"
            rest = "; ".join(shown(row.goal, one) for one in others)
            rows.add_row(row.key, row.unit, measured, str(len(best)), words(row.goal), state, row.prototype, rest)
    return rows


def cells_of(tried: Tried) -> Iterator[Cell]:
    """One cell for each row; a round is a try."""
    for row in tried.case.rows:
        rounds = [one.get(row.key, []) for one in tried.tries]
        yield Cell(variant="page", params={"case": tried.case.name}, measure=row.key, unit=row.unit, rounds=rounds)


def _notes(done: Sequence[Tried]) -> list[str]:
    loads = [
        f"{one.case.name}: load before {', '.join(f'{load:.2f}' for load in one.loads) or 'no try'}" for one in done
    ]
    return [*loads, *(f"{one.case.name}: {problem}" for one in done for problem in one.problems)]


def _write(results: Results, plan: PagePlan, console: Console) -> None:
    path = plan.output / "page.json"
    results.save(path)
    console.print(f"Written: {path}", style="dim", highlight=False, soft_wrap=True)
