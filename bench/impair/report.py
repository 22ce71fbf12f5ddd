"""The tables, the aims and the sentences of the trials. Pure."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence

from pebble.bench import paper
from pebble.bench.aims import Aim, outcome, single, with_lost
from pebble.bench.impair import metrics as measures
from pebble.bench.impair.conditions import CONDITIONS
from pebble.bench.ratios import paired
from pebble.bench.results import Cell, Judged, grouped, percentile
from pebble.bench.tables import Column, Grid, figure

QUOTED = (
    *paper.QUOTED,
    '"original" above is this program with the original\'s encodings, JSON pictures and PCM; it drops outdated media, '
    "and reduces pictures on a slow network.",
)
_LOSS_SHOWN = 0.005  # share of what was sent
_DRIVE_WAITS_MS = 100.0  # one command's time at 10 Hz
_OURS = "h264 opus"

_Value = Callable[[Cell], float]
_p95 = with_lost(95)


# -- the tables


def arrived(percent: float) -> _Value:
    """A percentile of what arrived; the share that arrived is in another column."""
    return lambda cell: cell.percentile(percent)


def _column(head: str, measure: str, value: str | _Value, *, whole: bool = False) -> Column:
    """Of a single value, or another one."""
    value_of = single(value) if isinstance(value, str) else value

    def shown(cell: Cell) -> str:
        found = value_of(cell)
        return "never" if math.isinf(found) else f"{found:.0f}" if whole and not math.isnan(found) else figure(found)

    return Column(head, shown, measure)


def _grid(title: str, *columns: Column) -> Grid:
    return Grid(
        title=title, rows=("trial", "variant"), heads=("trial", "subject"), columns=columns,
        of=lambda cell: "trial" in cell.params,
    )  # fmt: skip


TABLES = (
    _grid(
        "trials",
        _column("audio\n%", measures.SOUND, "delivered_percent"),
        _column("p95\nms", measures.SOUND, arrived(95)),
        _column("video\nfps", measures.PICTURES, "fps"),
        _column("frozen\ns", measures.PICTURES, "frozen_s"),
        _column("drive\np95 ms", measures.DRIVE, _p95),
        _column("heart-\nbeat\ngap s", measures.HEARTBEAT_GAP, "longest_gap_s"),
    ),
    _grid(
        "details of media",
        _column("video\nkbit/s", measures.PICTURES, "kbit_up"),
        _column("audio\nkbit/s", measures.SOUND, "kbit_up"),
        _column("video\ndrops", measures.PICTURES, "dropped_up", whole=True),
        _column("audio\ndrops", measures.SOUND, "dropped_up", whole=True),
        _column("audio\np50 ms", measures.SOUND, arrived(50)),
    ),
    _grid(
        "details of driving, and a clip",
        _column("drive\np50 ms", measures.DRIVE, with_lost(50)),
        _column("drive\n%", measures.DRIVE, "delivered_percent"),
        _column("stopped\ntimes", measures.DRIVE, "trips", whole=True),
        _column("at rest\ns", measures.DRIVE, "rest_s"),
        _column("clip\nms", measures.CLIP, with_lost(100)),
    ),
    _grid(
        "after media were switched off",
        *(
            column
            for what, measure in (("video", measures.AFTER_VIDEO), ("audio", measures.AFTER_AUDIO))
            for column in (
                _column(f"no {what}\nbytes", measure, "bytes_up", whole=True),
                _column("beats", measure, "heartbeats", whole=True),
                _column("gap\ns", measure, "longest_gap_s"),
            )
        ),
    ),
)


# -- the aims, for our own encodings


def _aim(
    trial: str, words: str, measure: str, value: str | _Value, unit: str,
    *, at_most: float | None = None, at_least: float | None = None,
) -> Aim:  # fmt: skip
    def beside(cell: Cell) -> str:
        """How much was lost, and in which window."""
        sent = cell.single("sent")
        lost = (cell.lost or 0) / sent if at_most is not None and sent > 0 else 0.0
        words = f", {figure(100 * lost)} % lost" if lost > _LOSS_SHOWN else ""
        return f"{words}, window of {cell.single('window_s'):.3g} s"

    return Aim(
        what=f"{{variant}} at {trial}, {words} {'at least' if at_most is None else 'at most'} {{bound:g}} {unit}",
        of=lambda cell: cell.variant.endswith(_OURS) and (cell.measure, cell.params.get("trial")) == (measure, trial),
        value=single(value) if isinstance(value, str) else value, unit=unit, least=0, never="too much was lost",
        beside=beside, at_most=at_most, at_least=at_least,
    )  # fmt: skip


def behind_media(cells: Sequence[Cell]) -> Iterator[Judged]:
    """The aim that commands do not wait behind media. Trials with loss or delay are excluded: they dominate the p95."""
    steady = {one.name for one in CONDITIONS if not one.up.loss and not one.up.timed}
    for subject, trials in _found(cells, measures.DRIVE_ALONE).items():
        waits = [
            (_p95(busy) - _p95(trials[trial]), f"{measure.removeprefix('drive during ')} at {trial}")
            for measure in (measures.DRIVE_VIDEO, measures.DRIVE_AUDIO)
            for trial, busy in _found(cells, measure).get(subject, {}).items()
            if trial in steady and math.isfinite(_p95(trials[trial]))
        ]
        if waits and subject.endswith(_OURS):
            longest_ms, where = max(waits, key=lambda one: one[0])
            most = f"most: {longest_ms:+.0f} ms" if math.isfinite(longest_ms) else "some were lost"
            yield Judged(
                what=f"{subject}, drive commands wait at most one command's time ({_DRIVE_WAITS_MS:g} ms) behind media"
                ", p95 against the same trial without",
                outcome=outcome(longest_ms <= _DRIVE_WAITS_MS),
                measured=f"{most}, {where}",
            )


AIMS = (
    _aim(paper.NARROW, "sound delivered", measures.SOUND, "delivered_percent", "%",
         at_least=paper.NARROW_SOUND_PERCENT),
    _aim(paper.NARROW, "sound p95", measures.SOUND, _p95, "ms", at_most=paper.NARROW_SOUND_P95_MS),
    _aim(paper.NARROW, "longest time without a new picture", measures.PICTURES, "longest_gap_s", "s",
         at_most=paper.NARROW_PICTURE_GAP_S),
    _aim(paper.WORST, "sound delivered", measures.SOUND, "delivered_percent", "%",
         at_least=paper.WORST_SOUND_PERCENT),
    _aim(paper.WORST, "drive p95", measures.DRIVE, _p95, "ms", at_most=paper.WORST_DRIVE_P95_MS),
    _aim(paper.WORST, "seen offline", measures.HEARTBEAT_GAP, "longest_offline_s", "s",
         at_most=paper.WORST_OFFLINE_S),
    behind_media,
)  # fmt: skip


# -- the sentences


def encodings(cells: Sequence[Cell]) -> Iterator[str]:
    share = single("on_time_percent")
    for trial in (paper.NARROW, paper.WORST):
        found = _found(cells, measures.SOUND).items()
        shares = [f"{subject} {figure(share(trials[trial]))} %" for subject, trials in found if trial in trials]
        if len(shares) > 1:
            yield f"Sound that arrived within a second at {trial}: {', '.join(shares)}."


def trips(cells: Sequence[Cell]) -> Iterator[str]:
    """Stops by the robot, and rest times of the wheels: a robot that no command reaches never stops."""
    lines = []
    for subject, trials in _found(cells, measures.DRIVE).items():
        times, rest_s, of_s = (sum(map(single(name), trials.values())) for name in ("trips", "rest_s", "window_s"))
        lines.append(f"{subject} {times:.0f} (wheels at rest for {figure(rest_s)} of {figure(of_s)} s)")
    yield f"Stops by the robot while it was driven: {', '.join(lines)}."


def clips(cells: Sequence[Cell]) -> Iterator[str]:
    lines = []
    for subject, trials in _found(cells, measures.CLIP).items():
        times = [sample for cell in trials.values() for sample in cell.samples]
        took = f" (p50 {figure(percentile(times, 50))} ms, longest {figure(max(times))} ms)" if times else ""
        lines.append(f"{subject} {len(times)} of {len(trials)}{took}")
    yield f"Clips that the loudspeaker played when commanded: {', '.join(lines)}."


def transports(cells: Sequence[Cell]) -> Iterator[str]:
    """Compares Zenoh and MQTT inside the robot, with trials as rounds: both ran at the same time."""
    for form in dict.fromkeys(subject.partition(" ")[2] for subject in _found(cells, measures.DRIVE)):
        for what, measure in (("drive", measures.DRIVE), ("sound", measures.SOUND), ("video", measures.PICTURES)):
            mqtt, zenoh = (_found(cells, measure).get(f"{kind} {form}", {}) for kind in ("mqtt", "zenoh"))
            common = [trial for trial in mqtt if trial in zenoh]
            if len(common) > 1:
                interval = paired([zenoh[trial].samples for trial in common], [mqtt[trial].samples for trial in common])
                yield f"{form}, {what} p50 over {len(common)} trials: {interval.words('zenoh', 'mqtt')}."


SENTENCES = (encodings, trips, clips, transports)


def _found(cells: Sequence[Cell], measure: str) -> dict[str, dict[str, Cell]]:
    """The cells of a measure by subject, then by trial."""
    subjects = grouped((cell for cell in cells if cell.measure == measure), lambda cell: cell.variant)
    return {subject: {str(cell.params["trial"]): cell for cell in own} for subject, own in subjects.items()}
