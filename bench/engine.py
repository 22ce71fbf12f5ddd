"""Runs a comparison: rounds in turn, failed ones left out, cells joined, aims judged, results printed and written."""

from __future__ import annotations

import tempfile
import time
from collections import defaultdict
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from importlib.util import find_spec
from operator import itemgetter
from pathlib import Path
from typing import Final

import msgspec
from rich.console import Console
from rich.markup import escape
from rich.measure import Measurement
from rich.table import Table

from pebble.bench.comparison import Combine, Comparison, Round, Run
from pebble.bench.judging import null
from pebble.bench.judging.ratios import LEAST_ROUNDS
from pebble.bench.results import OVER_TIME, Cell, Judged, Value, begin, grouped, named, percentile
from pebble.errors import PebbleError
from pebble.runtime.signals import interrupted_by_signals
from pebble.transports.segments import sweep

_WIDEST: Final = 200  # characters of a table
_GIVEN_UP: Final = 2  # rounds that fail before any has succeeded: then the run ends
_IN_US: Final = {"us": 1.0, "ms": 1e3, "s": 1e6}
_JOINED: Final[Mapping[str, Combine]] = {"sent": sum}


def run(run: Run) -> int:
    """Measures, prints and writes; returns 0 if everything has results of enough rounds. Raises PebbleError."""
    about, show = run.comparison, partial(run.console.print, highlight=False, soft_wrap=True)
    check_folder(run.output)
    about.measuring.prepare(run)
    collected = Collected(about, roles_of(run))
    results, since = begin(about.name, run.command, quick=run.quick), time.monotonic()
    with interrupted_by_signals():
        try:
            failed = _measure(run, collected)
        finally:
            sweep()  # Zenoh leaves files behind even after a regular end
    cells = collected.cells()
    results.cells, results.options, results.took_s = cells, run.records(), round(time.monotonic() - since, 1)
    results.complete = False
    results.save(written := run.output / f"{about.name}.json")  # before anything that may fail
    notes = [str(run.problem).partition("\n")[0]] if run.problem else []
    lost = f"{len(failed)} of {run.rounds} rounds failed and were left out"
    notes += [f"{lost}; {why.splitlines()[0]}" for why in failed[:1]]
    lines = [*(note[0].upper() + note[1:] for note in notes), *about.report.assessed(cells), *run.notes]
    results.assessment = [line for line in lines if isinstance(line, str)]
    results.aims = [line for line in lines if isinstance(line, Judged)]
    enough = run.rounds < LEAST_ROUNDS or run.rounds - len(failed) >= LEAST_ROUNDS
    results.complete = run.problem is None and enough and about.report.complete(cells)
    for table in about.report.shown(cells):
        _print_whole(table, run.console)
    for sentence in (*results.assessment, *results.aims):
        show(str(sentence))
    results.save(written)
    files = [written]
    if find_spec("matplotlib") is None:
        show("No plots: pip install 'pebble-robot[bench]'", style="dim")
    else:
        from pebble.bench.pictures import draw

        files += draw(results, run.output)
    show(f"Written: {', '.join(map(str, files))}", style="dim")
    if run.problem is not None:
        raise run.problem
    return int(not results.complete)


def _print_whole(table: Table, console: Console) -> None:
    """A narrow terminal breaks its lines, but no figure is cut off."""
    width = console.width
    console.width = max(width, Measurement.get(console, console.options.update(max_width=_WIDEST), table).maximum)
    console.print(table)
    console.width = width


def roles_of(run: Run) -> Sequence[str]:
    """The variants that this machine can measure, or the roles of the only one in a null test. Raises PebbleError."""
    about, null_of = run.comparison, run.options.get("null")
    asked = [null_of] if about.is_null and isinstance(null_of, str) else run.options.get("variants") or [""]
    reasons = {name: why for name in asked if name and (why := about.measuring.missing(name)) is not None}
    for name, why in reasons.items():
        run.console.print(f"{name} is left out: {why}", style="yellow", highlight=False, soft_wrap=True)
    if len(reasons) == len(asked):
        raise PebbleError("no variant can be measured on this machine")
    names = [*(name for name in asked if name not in reasons), *about.references]
    if about.is_null and (len(names) != 1 or len(about.conditions(run)) != 1):
        raise PebbleError("--null takes one variant, one size and one of everything else")
    return null.roles(names[0]) if about.is_null else names


def _measure(run: Run, collected: Collected) -> list[str]:
    """Returns why rounds failed: they are left out. Raises PebbleError if the first ones fail, since all would.

    Rounds share an environment: a new one every ``fresh_every`` rounds, and after a round that failed.
    """
    about, env, failed, fresh = run.comparison, None, list[str](), True
    measure = about.measuring.measure
    with run.console.status("", refresh_per_second=4) as status, ExitStack() as shared:
        for number in range(run.rounds):
            before = f"round {number + 1} of {run.rounds}: "
            run.show = lambda what, before=before: status.update(escape(before + what))  # type: ignore[misc]
            try:
                if fresh or number % run.options.get("fresh_every", 1) == 0:
                    shared.close()
                    env = shared.enter_context(about.measuring.environment(run))
                round_ = Round(run, number, env, roles=collected.roles, planted_us=collected.planted_us)
                if about.is_null and measure is not None and not collected.pilot:
                    collected.pilot = list(measure(next(one for one in round_.cases() if not one.slowed)))
                collected.add(_round(round_))
                fresh = False
            except (PebbleError, OSError) as error:
                fresh = True
                failed.append(f"round {number + 1}: {error}")
                if len(failed) == number + 1 == min(_GIVEN_UP, run.rounds):
                    raise
                run.console.print(failed[-1], style="red", highlight=False, markup=False)
    return failed


def _round(round_: Round) -> Iterator[Cell]:
    about = round_.run.comparison.measuring
    if about.measure_round is not None:
        yield from about.measure_round(round_)
    elif about.measure is not None:
        for case in round_.cases():
            try:
                yield from about.measure(case)
            except PebbleError as error:
                if not about.alone:
                    raise
                round_.run.console.print(f"{case}: {error}", style="red", highlight=False, markup=False, soft_wrap=True)
                yield from (case.cell(measure, "", []) for measure in about.measures)


class Collected:
    """Joins the cells of the rounds by variant, conditions and measure."""

    def __init__(self, comparison: Comparison, roles: Sequence[str]) -> None:
        self._about, self.roles = comparison, roles
        self._cells: dict[Hashable, Cell] = {}
        self._figures: defaultdict[tuple[Hashable, str], list[Value]] = defaultdict(list)
        self.pilot: list[Cell] = []  # of a null test, before the first round

    def add(self, cells: Iterable[Cell]) -> None:
        """Adds a round: all of it, or nothing if an error is raised meanwhile. Passes of a round are one."""
        for key, parts in grouped(cells, lambda cell: (cell.variant, cell.case)).items():
            cell = self._cells.setdefault(key, msgspec.structs.replace(parts[0], rounds=[], figures={}))
            cell.unit = cell.unit or parts[0].unit  # a case that failed has none
            joined = [[sample for part in parts for sample in part.samples]]
            cell.rounds += parts[0].rounds if cell.measure.endswith(OVER_TIME) else joined  # times, then values
            for name, value in (one for part in parts for one in part.figures.items()):
                self._figures[key, name].append(value)
                combine = {**_JOINED, **self._about.measuring.figures}.get(name, itemgetter(-1))
                cell.figures[name] = combine(self._figures[key, name])

    def cells(self) -> list[Cell]:
        """The measures in the order in which they are declared, if they are."""
        order = {measure: at for at, measure in enumerate(self._about.measuring.measures)}
        return sorted(self._cells.values(), key=lambda cell: order.get(cell.measure, 0))

    def planted_us(self, condition: Mapping[str, Value]) -> float:
        """A fifth of the usual latency so far in a null test; the first measure is the one that is tested."""
        if not self._about.is_null:
            return 0.0
        usual = [
            _IN_US[cell.unit] * percentile(cell.samples, 50)
            for cell in [*self._cells.values()] or self.pilot
            if not null.is_slowed(cell.variant) and cell.samples and condition.items() <= cell.params.items()
        ]
        return null.SLOWDOWN * percentile(usual or [0.0], 50)


def check_folder(folder: Path) -> None:
    """Raises PebbleError if the folder cannot be written: before an hour of measuring, not after it."""
    with named(folder):
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
