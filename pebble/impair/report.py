"""The trials as a table, and what they mean in words. Pure."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from rich.table import Table

from pebble.bench.ratios import LEAST_ROUNDS, paired
from pebble.bench.results import Cell, Results
from pebble.bench.tables import figure, plain_table
from pebble.impair import cells as measures
from pebble.impair.conditions import trials
from pebble.impair.plan import SUBJECTS, Subject

WIDE = 105  # columns of a terminal that the long form needs
QUOTED = (
    "Quoted, not measured here:",
    "  the original program, once through such a link: at 256k 40 % of its audio arrived (3.5 % within 1 s, p95 6.9 s) "
    "and 2.2 pictures a second; at 64k 5.7 % of its audio.",
    "  the paper (4.2): audio delivery about 80 % at best, degraded at 512k, broken by 256k.",
    '"original" above is this program in the original\'s encodings, JSON pictures and PCM: it never sends what is '
    "already old, and reduces pictures on a slow link.",
)
_DRIVE_WAITS_MS = 100.0  # one command's time at 10 Hz
_OURS = "h264 opus"


# -- the table


def tables(results: Results, width: int) -> Iterator[Table]:
    """One per form of media, the transports side by side; shorter where ``width`` is small."""
    forms = dict.fromkeys(subject.form for subject in SUBJECTS)
    for form in forms:
        subjects = [one for one in SUBJECTS if one.form == form and _trials(results.cells, one.name)]
        if subjects:
            yield _table(results, form, subjects, width >= WIDE)


def _table(results: Results, form: str, subjects: Sequence[Subject], wide: bool) -> Table:
    columns = [column for column in _COLUMNS if wide or column.always]
    heads = [
        f"{subject.transport if number == 0 else ''}\n{column.name}"
        for subject in subjects
        for number, column in enumerate(columns)
    ]
    options = results.options
    title = (
        f"{form}, over {options.get('link_words', options.get('link'))}, "
        f"windows of {options.get('window_s')} s{', quick' if results.quick else ''}"
    )
    table = plain_table(title, ["trial", *heads])
    for trial in _all_trials(results.cells):
        table.add_row(trial, *(column.of(results, one.name, trial) for one in subjects for column in columns))
    return table


@dataclass(frozen=True, slots=True)
class _Column:
    name: str
    measure: str
    value: Callable[[Cell], float]
    always: bool = True  # also in the short form

    def of(self, results: Results, subject: str, trial: str) -> str:
        cell = results.find(subject, self.measure, trial=trial)
        return "" if cell is None else figure(self.value(cell))


def _number(name: str) -> Callable[[Cell], float]:
    def of(cell: Cell) -> float:
        value = cell.figures.get(name)
        return float(value) if isinstance(value, int | float) else math.nan

    return of


def _p95(cell: Cell) -> float:
    return cell.percentile(95)


_COLUMNS = (
    _Column("audio\n%", measures.SOUND, _number("delivered_percent")),
    _Column("p95\nms", measures.SOUND, _p95),
    _Column("video\nfps", measures.PICTURES, _number("fps")),
    _Column("frozen\ns", measures.PICTURES, _number("frozen_s"), always=False),
    _Column("drive\np95 ms", measures.DRIVE, _p95),
    _Column("heart\ngap s", measures.BEAT_GAP, _number("longest_gap_s"), always=False),
)


# -- the verdict


@dataclass(frozen=True, slots=True)
class _Aim:
    trial: str
    words: str
    measure: str
    value: Callable[[Cell], float]
    limit: float
    unit: str
    least: bool = False  # else at most

    def line(self, subject: str, cell: Cell) -> str:
        value = self.value(cell)
        met = value >= self.limit if self.least else value <= self.limit
        shown = "nothing came" if math.isnan(value) else f"{_plain(value)} {self.unit}"
        if not met and not math.isnan(value):
            shown += f", by {_plain(abs(value - self.limit))} {self.unit}"
        bound = "at least" if self.least else "at most"
        text = f"aim: {subject} at {self.trial}, {self.words} {bound} {self.limit:g} {self.unit}"
        return f"{text}: {'met' if met else 'missed'} ({shown})"


_AIMS = (
    _Aim("256k", "sound delivered", measures.SOUND, _number("delivered_percent"), 99, "%", least=True),
    _Aim("256k", "sound p95", measures.SOUND, _p95, 400, "ms"),
    _Aim("256k", "longest time without a new picture", measures.PICTURES, _number("longest_gap_s"), 1, "s"),
    _Aim("64k+5%", "sound delivered", measures.SOUND, _number("delivered_percent"), 95, "%", least=True),
    _Aim("64k+5%", "drive p95", measures.DRIVE, _p95, 500, "ms"),
    _Aim("64k+5%", "seen offline", measures.BEAT_GAP, _number("longest_offline_s"), 2, "s"),
)


def verdict(cells: Sequence[Cell]) -> list[str]:
    """The aims for our own encodings, then what else there is to say."""
    ours = [one.name for one in SUBJECTS if one.form == _OURS and _trials(cells, one.name)]
    lines = [
        aim.line(subject, cell)
        for aim in _AIMS
        for subject in ours
        if (cell := _find(cells, subject, aim.measure, aim.trial)) is not None
    ]
    lines += [line for subject in ours if (line := _waiting(cells, subject))]
    return [*lines, *_encodings(cells), _trips(cells), *_transports(cells)]


def _waiting(cells: Sequence[Cell], subject: str) -> str:
    """Do commands wait behind media? Where packets are lost or held back on purpose, a p95 tells of that instead."""
    steady = {one.name for one in trials() if not one.up.loss and not one.up.timed}
    waits = {
        f"{measure.removeprefix('drive during ')} at {trial}": busy.percentile(95) - alone.percentile(95)
        for trial in _trials(cells, subject)
        if trial in steady
        for measure in (measures.DRIVE_VIDEO, measures.DRIVE_AUDIO)
        if (alone := _find(cells, subject, measures.DRIVE_ALONE, trial)) is not None
        and (busy := _find(cells, subject, measure, trial)) is not None
        and alone.samples
    }
    if not waits:
        return ""
    longest = max(waits, key=lambda name: math.inf if math.isnan(waits[name]) else waits[name])
    met = waits[longest] <= _DRIVE_WAITS_MS
    words = f"aim: {subject}, drive commands wait at most one command's time ({_DRIVE_WAITS_MS:g} ms) behind media"
    most = "no command came" if math.isnan(waits[longest]) else f"most: {waits[longest]:+.0f} ms"
    return f"{words}, p95 against the same trial without: {'met' if met else 'missed'} ({most}, {longest})"


def _encodings(cells: Sequence[Cell]) -> Iterator[str]:
    for trial in ("256k", "64k+5%"):
        shares = [
            f"{subject.name} {_plain(_number('on_time_percent')(cell))} %"
            for subject in SUBJECTS
            if (cell := _find(cells, subject.name, measures.SOUND, trial)) is not None
        ]
        if len(shares) > 1:
            yield f"Sound that arrived within a second at {trial}: {', '.join(shares)}."


def _trips(cells: Sequence[Cell]) -> str:
    trips = {subject.name: 0 for subject in SUBJECTS if _trials(cells, subject.name)}
    for cell in cells:
        if cell.measure == measures.DRIVE:
            trips[cell.variant] += round(_number("trips")(cell))
    if not any(trips.values()):
        return "No robot stopped by itself while it was driven."
    times = ", ".join(f"{name} {count} times" for name, count in trips.items())
    return f"Stopped by itself while it was driven: {times}."


def _transports(cells: Sequence[Cell]) -> Iterator[str]:
    """Zenoh and MQTT inside the robot, the trials as rounds: both were in each at the same time."""
    for form in dict.fromkeys(subject.form for subject in SUBJECTS):
        for what, measure in (("drive", measures.DRIVE), ("sound", measures.SOUND), ("video", measures.PICTURES)):
            mqtt, zenoh = (_by_trial(cells, f"{kind} {form}", measure) for kind in ("mqtt", "zenoh"))
            common = [trial for trial in mqtt if trial in zenoh]
            if len(common) > 1:
                interval = paired([zenoh[trial].samples for trial in common], [mqtt[trial].samples for trial in common])
                few = "" if len(common) >= LEAST_ROUNDS else f" (so few trials tell little; {LEAST_ROUNDS} would)"
                yield f"{form}, {what} p50 over {len(common)} trials: {interval.words('zenoh', 'mqtt')}{few}."


def _by_trial(cells: Sequence[Cell], subject: str, measure: str) -> dict[str, Cell]:
    return {
        str(cell.params["trial"]): cell
        for cell in cells
        if cell.variant == subject and cell.measure == measure and "trial" in cell.params
    }


def _find(cells: Sequence[Cell], subject: str, measure: str, trial: str) -> Cell | None:
    return _by_trial(cells, subject, measure).get(trial)


def _trials(cells: Sequence[Cell], subject: str) -> list[str]:
    return list(_by_trial(cells, subject, measures.DRIVE))


def _all_trials(cells: Sequence[Cell]) -> list[str]:
    return list(dict.fromkeys(trial for subject in SUBJECTS for trial in _trials(cells, subject.name)))


def _plain(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.1f}" if abs(value) >= 10 else f"{value:.2f}"
