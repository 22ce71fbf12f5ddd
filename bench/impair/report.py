"""The tables and the assessment of the trials. Pure."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from rich.table import Table

from pebble.bench import paper
from pebble.bench.aims import outcome
from pebble.bench.impair import cells as measures
from pebble.bench.impair.conditions import trials
from pebble.bench.impair.plan import SUBJECTS, Subject
from pebble.bench.ratios import paired
from pebble.bench.results import Cell, Judged, Results, percentile
from pebble.bench.tables import figure, plain_table

WIDE = 105  # columns of a terminal that the long form needs
QUOTED = (
    *paper.QUOTED,
    '"original" above is this program with the original\'s encodings, JSON pictures and PCM; it drops outdated media, '
    "and reduces pictures on a slow network.",
)
_LOSS_SHOWN = 0.005  # share of what was sent
_DRIVE_WAITS_MS = 100.0  # one command's time at 10 Hz
_OURS = "h264 opus"


# -- the table


def tables(results: Results, width: int) -> Iterator[Table]:
    """One table per form with the transports side by side, and one of details; fewer columns if ``width`` is small."""
    forms = dict.fromkeys(subject.form for subject in SUBJECTS)
    for form in forms:
        subjects = [one for one in SUBJECTS if one.form == form and _trials(results.cells, one.name)]
        if subjects:
            yield _table(results, form, subjects, width >= WIDE)
        if subjects and width >= WIDE:
            yield _by_transport(f"details of {_title(results, form)}", _DETAILS, results, subjects)
        if subjects:
            title = f"a clip, and {results.options.get('off_s')} s without media, of {_title(results, form)}"
            yield _by_transport(title, _AFTERWARDS, results, subjects)


def _table(results: Results, form: str, subjects: Sequence[Subject], wide: bool) -> Table:
    columns = [column for column in _COLUMNS if wide or column.always]
    heads = [
        f"{subject.transport if number == 0 else ''}\n{column.name}"
        for subject in subjects
        for number, column in enumerate(columns)
    ]
    table = plain_table(_title(results, form), ["trial", *heads])
    for trial in _all_trials(results.cells):
        table.add_row(trial, *(column.of(results, one.name, trial) for one in subjects for column in columns))
    return table


def _by_transport(title: str, shown: Sequence[_Column], results: Results, subjects: Sequence[Subject]) -> Table:
    """A row for each transport in each trial."""
    table = plain_table(title, ["trial", "inside", *(column.name for column in shown)], left=2)
    for trial in _all_trials(results.cells):
        for number, one in enumerate(subjects):
            figures = [column.of(results, one.name, trial) for column in shown]
            table.add_row("" if number else trial, one.transport, *figures)
    return table


def _title(results: Results, form: str) -> str:
    options = results.options
    words, window = options.get("link_words", options.get("link")), options.get("window_s")
    return f"{form}, over {words}, windows of {window} s{', quick' if results.quick else ''}"


@dataclass(frozen=True, slots=True)
class _Column:
    name: str
    measure: str
    value: Callable[[Cell], float]
    always: bool = True  # also in the short form
    whole: bool = False

    def of(self, results: Results, subject: str, trial: str) -> str:
        cell = results.find(subject, self.measure, trial=trial)
        value = math.nan if cell is None else self.value(cell)
        if value == math.inf:
            return "never"
        return f"{value:.0f}" if self.whole and not math.isnan(value) else figure(value)


def _number(name: str) -> Callable[[Cell], float]:
    def of(cell: Cell) -> float:
        value = cell.figures.get(name)
        return float(value) if isinstance(value, int | float) else math.nan

    return of


def _percentile(percent: float) -> Callable[[Cell], float]:
    """A percentile in which lost messages are infinitely late."""
    return lambda cell: percentile([*cell.samples, *[math.inf] * (cell.lost or 0)], percent)


_p95 = _percentile(95)


def _arrived(percent: float) -> Callable[[Cell], float]:
    """A percentile of what arrived; the share that arrived is in another column."""
    return lambda cell: cell.percentile(percent)


_COLUMNS = (
    _Column("audio\n%", measures.SOUND, _number("delivered_percent")),
    _Column("p95\nms", measures.SOUND, _arrived(95)),
    _Column("video\nfps", measures.PICTURES, _number("fps")),
    _Column("frozen\ns", measures.PICTURES, _number("frozen_s"), always=False),
    _Column("drive\np95 ms", measures.DRIVE, _p95),
    _Column("heartbeat\ngap s", measures.HEARTBEAT_GAP, _number("longest_gap_s"), always=False),
)
_DETAILS = (
    _Column("video\nkbit/s", measures.PICTURES, _number("kbit_up")),
    _Column("audio\nkbit/s", measures.SOUND, _number("kbit_up")),
    _Column("video\ndrops", measures.PICTURES, _number("dropped_up"), whole=True),
    _Column("audio\ndrops", measures.SOUND, _number("dropped_up"), whole=True),
    _Column("audio\np50 ms", measures.SOUND, _arrived(50)),
    _Column("drive\np50 ms", measures.DRIVE, _percentile(50)),
    _Column("drive\n%", measures.DRIVE, _number("delivered_percent")),
    _Column("stopped\ntimes", measures.DRIVE, _number("trips"), whole=True),
    _Column("at rest\ns", measures.DRIVE, _number("rest_s")),
)
_AFTERWARDS = (
    _Column("clip\nms", measures.CLIP, _percentile(100)),
    _Column("no video\nbytes", measures.AFTER_VIDEO, _number("bytes_up"), whole=True),
    _Column("heart-\nbeats", measures.AFTER_VIDEO, _number("heartbeats"), whole=True),
    _Column("gap\ns", measures.AFTER_VIDEO, _number("longest_gap_s")),
    _Column("no audio\nbytes", measures.AFTER_AUDIO, _number("bytes_up"), whole=True),
    _Column("heart-\nbeats", measures.AFTER_AUDIO, _number("heartbeats"), whole=True),
    _Column("gap\ns", measures.AFTER_AUDIO, _number("longest_gap_s")),
)


# -- the assessment


@dataclass(frozen=True, slots=True)
class _Aim:
    trial: str
    words: str
    measure: str
    value: Callable[[Cell], float]
    limit: float
    unit: str
    least: bool = False  # else at most

    def judged(self, subject: str, cell: Cell) -> Judged:
        value = self.value(cell)
        met = value >= self.limit if self.least else value <= self.limit
        shown = f"{_plain(value)} {self.unit}" if math.isfinite(value) else "too much was lost"
        if not cell.samples and math.isnan(value):
            shown = "nothing arrived"
        elif not met and math.isfinite(value):
            shown += f", by {_plain(abs(value - self.limit))} {self.unit}"
        shown += f"{'' if self.least else _lost(cell)}, window of {_number('window_s')(cell):.3g} s"
        bound = "at least" if self.least else "at most"
        what = f"{subject} at {self.trial}, {self.words} {bound} {self.limit:g} {self.unit}"
        return Judged(what=what, outcome=outcome(met), measured=shown)


_AIMS = (
    _Aim(paper.NARROW, "sound delivered", measures.SOUND, _number("delivered_percent"), paper.NARROW_SOUND_PERCENT, "%",
         least=True),
    _Aim(paper.NARROW, "sound p95", measures.SOUND, _p95, paper.NARROW_SOUND_P95_MS, "ms"),
    _Aim(paper.NARROW, "longest time without a new picture", measures.PICTURES, _number("longest_gap_s"),
         paper.NARROW_PICTURE_GAP_S, "s"),
    _Aim(paper.WORST, "sound delivered", measures.SOUND, _number("delivered_percent"), paper.WORST_SOUND_PERCENT, "%",
         least=True),
    _Aim(paper.WORST, "drive p95", measures.DRIVE, _p95, paper.WORST_DRIVE_P95_MS, "ms"),
    _Aim(paper.WORST, "seen offline", measures.HEARTBEAT_GAP, _number("longest_offline_s"), paper.WORST_OFFLINE_S, "s"),
)  # fmt: skip


def _lost(cell: Cell) -> str:
    """The lost share as text, if it exceeds a threshold."""
    sent = cell.figures.get("sent")
    share = (cell.lost or 0) / sent if isinstance(sent, int) and sent else 0.0
    return f", {_plain(100 * share)} % lost" if share > _LOSS_SHOWN else ""


def assessment(cells: Sequence[Cell]) -> list[str | Judged]:
    """The aims for our own encodings, then comparisons."""
    ours = [one.name for one in SUBJECTS if one.form == _OURS and _trials(cells, one.name)]
    judged = [
        aim.judged(subject, cell)
        for aim in _AIMS
        for subject in ours
        if (cell := _find(cells, subject, aim.measure, aim.trial)) is not None
    ]
    judged += [one for subject in ours for one in _media_delay_aim(cells, subject)]
    return [*judged, *_encodings(cells), _trips(cells), *_clips(cells), *_transports(cells)]


def _media_delay_aim(cells: Sequence[Cell], subject: str) -> Iterator[Judged]:
    """The aim that commands do not wait behind media. Trials with loss or delay are excluded: they dominate the p95."""
    steady = {one.name for one in trials() if not one.up.loss and not one.up.timed}
    waits = {
        f"{measure.removeprefix('drive during ')} at {trial}": _p95(busy) - _p95(alone)
        for trial in _trials(cells, subject)
        if trial in steady
        for measure in (measures.DRIVE_VIDEO, measures.DRIVE_AUDIO)
        if (alone := _find(cells, subject, measures.DRIVE_ALONE, trial)) is not None
        and (busy := _find(cells, subject, measure, trial)) is not None
        and math.isfinite(_p95(alone))
    }
    if not waits:
        return
    longest = max(waits, key=lambda name: waits[name])
    met = waits[longest] <= _DRIVE_WAITS_MS
    what = f"{subject}, drive commands wait at most one command's time ({_DRIVE_WAITS_MS:g} ms) behind media"
    most = f"most: {waits[longest]:+.0f} ms" if math.isfinite(waits[longest]) else "some were lost"
    what += ", p95 against the same trial without"
    yield Judged(what=what, outcome=outcome(met), measured=f"{most}, {longest}")


def _encodings(cells: Sequence[Cell]) -> Iterator[str]:
    for trial in (paper.NARROW, paper.WORST):
        shares = [
            f"{subject.name} {_plain(_number('on_time_percent')(cell))} %"
            for subject in SUBJECTS
            if (cell := _find(cells, subject.name, measures.SOUND, trial)) is not None
        ]
        if len(shares) > 1:
            yield f"Sound that arrived within a second at {trial}: {', '.join(shares)}."


def _clips(cells: Sequence[Cell]) -> Iterator[str]:
    played = {subject.name: list(_by_trial(cells, subject.name, measures.CLIP).values()) for subject in SUBJECTS}
    words = [
        f"{name} {sum(len(cell.samples) for cell in found)} of {len(found)}"
        + (f" (p50 {_plain(percentile(times, 50))} ms, longest {_plain(max(times))} ms)" if times else "")
        for name, found in played.items()
        if found
        for times in [[sample for cell in found for sample in cell.samples]]
    ]
    if words:
        yield f"Clips that the loudspeaker played when commanded: {', '.join(words)}."


def _trips(cells: Sequence[Cell]) -> str:
    """Stops by the robot, and rest times of the wheels: a robot that no command reaches never stops."""
    lines = []
    for subject in SUBJECTS:
        driven = _by_trial(cells, subject.name, measures.DRIVE).values()
        trips, rest_s, of_s = (sum(map(_number(name), driven)) for name in ("trips", "rest_s", "window_s"))
        if driven:
            lines.append(f"{subject.name} {trips:.0f} (wheels at rest for {_plain(rest_s)} of {_plain(of_s)} s)")
    return f"Stops by the robot while it was driven: {', '.join(lines)}."


def _transports(cells: Sequence[Cell]) -> Iterator[str]:
    """Compares Zenoh and MQTT inside the robot, with trials as rounds: both ran at the same time."""
    for form in dict.fromkeys(subject.form for subject in SUBJECTS):
        for what, measure in (("drive", measures.DRIVE), ("sound", measures.SOUND), ("video", measures.PICTURES)):
            mqtt, zenoh = (_by_trial(cells, f"{kind} {form}", measure) for kind in ("mqtt", "zenoh"))
            common = [trial for trial in mqtt if trial in zenoh]
            if len(common) > 1:
                interval = paired([zenoh[trial].samples for trial in common], [mqtt[trial].samples for trial in common])
                yield f"{form}, {what} p50 over {len(common)} trials: {interval.words('zenoh', 'mqtt')}."


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
