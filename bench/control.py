"""Measures the latency of messages between two services, one-way and round trip, on MQTT and Zenoh in turn."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import fmean, median
from typing import Any

from msgspec import structs
from rich.table import Table

from pebble.bench import control_far as far
from pebble.bench import null
from pebble.bench.aims import MISSED, NOT_JUDGED, outcome, rounds_with_lost, single
from pebble.bench.comparison import Budget, Case, Combine, Comparison, Option, Run, of_known, rounds, seconds, variants
from pebble.bench.control_ends import ONE_WAY, ROUND_TRIP, SMALLEST, SliceSpec, rate_name, size_name
from pebble.bench.control_participants import (
    BASELINE,
    HOG,
    HUB,
    LOADS,
    MEDIA,
    MQTT,
    NONE,
    P2P,
    PICTURES_HZ,
    VARIANTS,
    Participants,
)
from pebble.bench.engine import roles_of
from pebble.bench.pictures import ecdf, null_ratios, ratios
from pebble.bench.ratios import LEAST_ROUNDS, Interval, paired
from pebble.bench.results import Cell, Judged, Value, grouped, percentile, rounded
from pebble.bench.tables import Column, Grid, base_of, figure
from pebble.bench.usage import wake_up_us
from pebble.errors import PebbleError

SIZES = (40, 1024)
RATES = (20.0, 200.0, 1000.0)
LOADED_SIZE, LOADED_RATES = 40, (20.0, 200.0)  # with a load, unless given
_LARGEST, _FASTEST = 1 << 20, 2000.0
_LONG_US = 995.0
_MUCH_LATE, _MUCH_LOST = 0.05, 0.005
_FEWER_HZ = 0.9 * PICTURES_HZ  # pictures: the load is lighter than intended
AIM_P50, AIM_MEDIA_P99 = 0.70, 0.35
_JUDGED = {"size": "40 B", "rate": "200 Hz"}

_Key = tuple[str | None, str]  # variant and load
_ByKey = Mapping[_Key, Cell]


def conditions(run: Run) -> list[dict[str, Value]]:
    """With sizes or rates given all of them with every load, else only some with a load."""
    one, given = run.quick or run.comparison.is_null, run["sizes"] is not None or run["rates"] is not None
    return [
        {"size": size_name(size), "rate": rate_name(rate), "load": load}
        for load in _loads(run)
        for size in run["sizes"] or ((LOADED_SIZE,) if one else SIZES)
        for rate in run["rates"] or ((200.0,) if one else RATES)
        if one or given or load == NONE or (size == LOADED_SIZE and rate in LOADED_RATES)
    ]


def _loads(run: Run) -> list[str]:
    return list(run["loads"] or ((NONE,) if run.comparison.is_null else (NONE, MEDIA) if run.quick else LOADS))


def prepare(run: Run) -> None:
    run.recorded["loads"] = [*_loads(run)]


def measure(case: Case) -> Iterator[Cell]:
    """One slice. The null test uses only the one-way times, since its slowdown is a fifth of them."""
    answer, used = case.env.run(case.role, SliceSpec.of(case), str(case.condition["load"]))
    hops = {"call_us": answer.call, "fabric_us": answer.transport_times, "inbox_us": answer.inbox}
    figures: dict[str, Any] = {
        "sent": answer.sent,
        "late": answer.late,
        **{name: rounded(percentile(times, 50), 1) for name, times in hops.items()},
        "pictures_hz": None,
        **used,
    }
    yield case.cell(ONE_WAY, "us", answer.one_way, **figures)
    if not case.run.comparison.is_null:
        yield case.cell(ROUND_TRIP, "us", answer.round_trip, **figures)


# -- the tables, for a terminal of 80 columns


def legend(cells: Sequence[Cell]) -> list[str]:
    names = dict.fromkeys(null.variant_of(cell.variant) for cell in cells)
    return [f"{name}: {VARIANTS[name].about}" for name in names]


def tables(cells: Sequence[Cell]) -> Iterator[Table]:
    """One table per measure with a column for each variant; then the ratios to the baseline, if it was measured."""
    yield from _side_by_side(
        "{measure}, us: p50/p99 (k: thousands)",
        cells,
        lambda cell: f"{_short(cell.percentile(50))}/{_short(cell.percentile(99))}",
    )
    others = [cell for cell in cells if cell.measure == ONE_WAY and base_of(cell, cells, BASELINE) is not None]
    title = f"{{measure}}, p50 as a ratio to that of {BASELINE}, and its 99 % interval"
    yield from _side_by_side(title, others, lambda cell: _ratio(cell, base_of(cell, cells, BASELINE)))
    if any(map(_HOPS.of, cells)):
        yield from _HOPS(cells)


def _side_by_side(title: str, cells: Sequence[Cell], shown: Callable[[Cell], str]) -> Iterator[Table]:
    """A row for each condition, a column for each variant."""
    names = list(dict.fromkeys(cell.variant for cell in cells))
    column = Column(names[0] if len(names) == 1 else "", shown)
    for table in Grid(title=title, rows=("size", "rate", "load"), columns=(column,), each=("measure",))(cells):
        table.padding = 0  # six variants in 80 columns
        for head in table.columns:
            head.header = str(head.header).replace("-", "-\n").replace(" ", "\n", 1)
        yield table


def _short(us: float) -> str:
    """Formats microseconds in at most four characters."""
    if us < _LONG_US:
        return figure(us)
    return f"{us / 1000:.1f}k" if us < 10 * _LONG_US else f"{us / 1000:.0f}k"


def _ratio(cell: Cell, base: Cell | None) -> str:
    """Formats a ratio on two lines, so that five fit side by side."""
    interval = Interval() if base is None else paired(cell.rounds, base.rounds)
    if interval.few:
        return str(interval)
    return f"{figure(interval.ratio)}\n{figure(interval.low)}–{figure(interval.high)}"


def _is_judged(cell: Cell) -> bool:
    return cell.measure == ONE_WAY and _JUDGED.items() <= cell.params.items()


def _hop(head: str, name: str) -> Column:
    return Column(head, lambda cell: figure(single(name)(cell)))


_HOPS = Grid(
    title="where the time goes: 40 B at 200 Hz, unloaded, medians, us",
    rows=("variant",),
    columns=(
        _hop("publish\ncall", "call_us"),
        _hop("thread\nhas it", "fabric_us"),
        _hop("handler\nruns", "inbox_us"),
        _hop("wake-ups:\nends", "wake_ups"),
        _hop("broker\nor hub", "broker_wake_ups"),
    ),
    of=lambda cell: _is_judged(cell) and cell.params["load"] == NONE and "fabric_us" in cell.figures,
)


# -- the assessment


def wake_up_cost(cells: Sequence[Cell]) -> Iterator[str]:
    """The cost of one wake-up on this machine, on the same core and another one, and the wake-ups per message."""
    by_key, shown = _judged(cells), []
    for name in (_better(by_key, NONE, 50), P2P):
        figures = by_key[name, NONE].figures if (name, NONE) in by_key else {}
        ends, backbone = (float(figures.get(key) or 0) for key in ("wake_ups", "broker_wake_ups"))
        if ends:
            shown.append(f"{ends + backbone:.1f} with {name}")
    if not shown:
        return
    try:
        same_us, other_us = wake_up_us()
    except PebbleError as error:
        yield str(error)
    else:
        yield (
            f"Waking up a waiting process takes {same_us:.0f} us on the same core, {other_us:.0f} us on another; "
            f"a round trip takes {' and '.join(shown)} such wake-ups, including brokers."
        )


def assessment(cells: Sequence[Cell]) -> list[str | Judged]:
    """One sentence for each comparison that was measured, warnings, and the aims."""
    by_key = _judged(cells)
    best, best_loaded = _better(by_key, NONE, 50), _better(by_key, MEDIA, 99)

    def compare(percent: float, ours: _Key, theirs: _Key, before: str = "", names: Sequence[str] = ()) -> list[str]:
        interval = _ratio_of(by_key, ours, theirs, percent)
        if interval is None:
            return []
        one, other = names or (str(ours[0]), str(theirs[0]))
        return [f"{before}{'' if percent == 50 else f'p{percent:g}: '}{interval.words(one, other)}"]

    better = "{} (the better MQTT variant)".format
    lines = [
        *compare(50, (P2P, NONE), (best, NONE), names=(P2P, better(best))),
        *compare(99, (P2P, MEDIA), (best_loaded, MEDIA), f"with {MEDIA}, ", (P2P, better(best_loaded))),
        *_pictures(by_key),
        *compare(50, (HUB, NONE), (P2P, NONE)),
    ]
    for name in (P2P, best):
        for percent in (50, 99):
            names = (f"{name} beside a busy process", f"{name} alone")
            lines += compare(percent, (name, HOG), (name, NONE), names=names)
    for slow in ("paho", "mqtt"):
        for percent in (50, 99):
            lines += compare(percent, (slow, NONE), ("mqtt-nodelay", NONE), "Nagle: ")
    lines += compare(50, ("mqtt5", NONE), ("mqtt-nodelay", NONE))
    what = "40 B at 200 Hz, one way, medians unless p99 is named; with the 99 % interval of the ratio."
    return [*([what, *lines] if lines else []), *_warnings(cells), *_aims(by_key)]


def _judged(cells: Sequence[Cell]) -> _ByKey:
    return {(cell.variant, str(cell.params["load"])): cell for cell in cells if _is_judged(cell)}


def _better(by_key: _ByKey, load: str, percent: float) -> str | None:
    """The MQTT variant with the lowest percentile."""
    there = [cell for name in MQTT if (cell := by_key.get((name, load))) is not None and cell.samples]
    best = min(there, key=lambda cell: cell.percentile(percent), default=None)
    return None if best is None else best.variant


def _ratio_of(by_key: _ByKey, ours: _Key, theirs: _Key, percent: float) -> Interval | None:
    """None if one of the two was not measured."""
    if ours not in by_key or theirs not in by_key:
        return None
    return paired(by_key[ours].rounds, by_key[theirs].rounds, percent)


def _pictures(by_key: _ByKey) -> Iterator[str]:
    """The rate of pictures meanwhile: a variant that carries fewer has a lighter load."""
    rates = {str(name): single("pictures_hz")(cell) for (name, load), cell in by_key.items() if load == MEDIA}
    if known := {name: rate for name, rate in rates.items() if not math.isnan(rate)}:
        shown = ", ".join(f"{name} {figure(rate)}" for name, rate in known.items())
        yield f"With media, pictures received per second, of {PICTURES_HZ:g}: {shown}"
    if fewer := [name for name, rate in known.items() if rate < _FEWER_HZ]:
        yield f"With media, {', '.join(fewer)}: fewer than {_FEWER_HZ:g} pictures per second, so the load was lighter."


def _warnings(cells: Sequence[Cell]) -> Iterator[str]:
    """Reasons to distrust the results: too few rounds, late or lost messages."""
    if min((len(cell.rounds) for cell in cells), default=0) < LEAST_ROUNDS:
        yield f"A 99 % interval needs {LEAST_ROUNDS} rounds."
    one_way = [cell for cell in cells if cell.measure == ONE_WAY]
    for rate, ours in grouped(one_way, lambda cell: cell.params["rate"]).items():
        late, sent = _total(ours, "late"), _total(ours, "sent")
        if late > _MUCH_LATE * sent:
            yield f"At {rate} {late / sent:.0%} of the messages were sent late: this machine cannot keep that rate."
        shares = {
            name: sum(cell.lost or 0 for cell in own) / max(1, _total(own, "sent"))
            for name, own in grouped(ours, lambda cell: cell.variant).items()
        }
        if lost := ", ".join(f"{share:.1%} of {name}" for name, share in shares.items() if share > _MUCH_LOST):
            yield f"At {rate} messages were lost: {lost}. Percentiles exclude them, aims count them as infinitely late."


def _total(cells: Sequence[Cell], name: str) -> int:
    return sum(int(cell.figures.get(name) or 0) for cell in cells)


def _aims(by_key: _ByKey) -> Iterator[Judged]:
    """The aim for p50 applies to the upper end of the interval, the one for p99 to the ratio, as they were set.

    If too many messages were lost in total, the aim is missed even if few rounds lost them.
    """
    by_key = {key: structs.replace(cell, rounds=rounds_with_lost(cell)) for key, cell in by_key.items()}
    without = _ratio_of(by_key, (P2P, NONE), (_better(by_key, NONE, 50), NONE), 50)
    if without is not None:
        yield _aim(f"{P2P} / better MQTT, p50, upper end of the interval", without.high, AIM_P50, without)
    media = _ratio_of(by_key, (P2P, MEDIA), (_better(by_key, MEDIA, 99), MEDIA), 99)
    if media is not None:
        value = media.ratio if math.isfinite(by_key[P2P, MEDIA].percentile(99)) else math.inf
        yield _aim(f"{P2P} / better MQTT with media, p99", value, AIM_MEDIA_P99, media)


def _aim(what: str, value: float, aim: float, interval: Interval) -> Judged:
    """A ratio that is equal to 1 within noise does not meet an aim."""
    if interval.few:
        how, why = NOT_JUDGED, f" of {interval.rounds} rounds"
    elif math.isinf(value):
        how, why = MISSED, ", too much was lost"
    elif interval.equal:
        how, why = MISSED, ", equal within noise"
    else:
        how, why = outcome(value <= aim), ""
    return Judged(what=f"{what}, at most {aim:.2f}", outcome=how, measured=f"{interval}{why}")


# -- the declarations

_USED = ("cpu_percent", "broker_cpu_percent", "wake_ups", "broker_wake_ups", "pictures_hz")
_JOINED: Mapping[str, Combine] = {
    "late": sum,
    **dict.fromkeys(("call_us", "fabric_us", "inbox_us"), of_known(median, 1)),
    **dict.fromkeys(_USED, of_known(fmean, 1)),
}
_list = partial(Option, many=True, recorded=False)
_OPTIONS = (
    variants(tuple(VARIANTS)),
    _list(
        name="sizes", kind=int, least=SMALLEST, most=_LARGEST, metavar="BYTES", help="Bytes, for example 40,1024."
    ),
    _list(
        name="rates", kind=float, least=1, most=_FASTEST, metavar="HZ", help="Messages a second, for example 20,200."
    ),
    _list(name="loads", known=LOADS, metavar="NAMES", help="Some of none, media and hog."),
    seconds("Duration of one case in a round."),
    rounds("Rounds of all cases."),
    Option(
        name="null", kind=bool, recorded=False, help="One variant against itself, and against itself slowed by a fifth."
    ),
    Option(name="far", metavar="URL", private=True, help="Measure against `pebble bench echo` on another machine."),
    Option(
        name="password-file", kind=Path, metavar="FILE", private=True,
        help="File with the broker's password; else $PEBBLE_PASSWORD.",
    ),
    Option(
        name="ca-cert", kind=Path, metavar="FILE", private=True,
        help="Certificate authority to trust with mqtts://.",
    ),
)  # fmt: skip
_UNSET = dict.fromkeys(("sizes", "rates", "loads", "null", "far", "password-file", "ca-cert"))

CONTROL_FAR = Comparison(
    name="control-far",
    title="Between two machines",
    what="Round trips to an echo on another machine, and one-way times as precise as the two clocks allow.",
    options=_OPTIONS,
    full=Budget(90, **_UNSET, seconds=2.0, rounds=10, fresh_every=10_000),  # one connection for all rounds
    quick=Budget(5, seconds=1.0, rounds=4),
    variants=(far.VARIANT,),
    conditions=far.conditions,
    prepare=far.prepare,
    environment=far.environment,
    measure=far.measure,
    measures=far.MEASURES,
    figures=far.JOINED,
    derived=far.derived,
    tables=far.TABLES,
    assessment=(far.assessment,),
    complete=lambda cells: all(cell.samples for cell in cells if cell.measure == ROUND_TRIP),
    words=("bench", "control"),
    reported=None,
    pictures=(ecdf("Control far"),),
)
_CONTROL = Comparison(
    name="control",
    title="Service to service",
    what="A message of a drive command's size goes from one process to another and back, as between a robot's "
    "services: unloaded, with camera frames on the same transport, and beside a process that uses a whole core. "
    "One-way is from just before the publish call until the receiver's handler runs; both ends use the same clock.",
    help="""Round trips between two services: MQTT and Zenoh; unloaded, with camera frames, beside a busy process.

    Each round starts two processes and a broker or hub for each variant. Needs mosquitto.
    With --null: one variant (zenoh-p2p), 40 B at 200 Hz. The run fails if it finds a difference where there is none,
    or misses the planted one.

    \b
        pebble bench control
        pebble bench control --variants mqtt,zenoh-p2p --sizes 40 --rates 200 --rounds 20
        pebble bench control --null --variants mqtt
        pebble bench control --far mqtt://broker.local
    """,
    options=_OPTIONS,
    full=Budget(700, **_UNSET, seconds=0.35, rounds=10, passes=2, fresh_every=1),
    quick=Budget(40, seconds=0.3, rounds=4, passes=1, fresh_every=2),
    variants=tuple(VARIANTS),
    conditions=conditions,
    prepare=prepare,
    environment=lambda run: Participants(roles_of(run), _loads(run)),
    measure=measure,
    measures=(ONE_WAY, ROUND_TRIP),
    figures=_JOINED,
    tables=(tables,),
    legend=legend,
    assessment=(wake_up_cost, assessment),
    summary_lines=5,
    pictures=(ecdf("Service to service"), ratios("Service to service", "mqtt")),
)
CONTROL_NULL = replace(
    _CONTROL,
    name="control-null",
    title="Service to service: the null test",
    what="One variant against itself, and against itself with a fifth of its usual latency planted by the sender. "
    "The first interval must include 1.00, the second must lie above it; otherwise the comparison above finds "
    "differences that do not exist, or misses some that do.",
    full=Budget(180, **{**_UNSET, "null": True}, seconds=0.3, rounds=30, passes=2, fresh_every=1),
    quick=Budget(10, seconds=0.25, rounds=4, passes=1, fresh_every=2),
    is_null=True,
    variants=(P2P,),
    assessment=(null.assessment,),
    words=("bench", "control"),
    reported=("--null",),
    summary_lines=0,
    pictures=(null_ratios("Null test of control"), ecdf("Null test of control")),
)
CONTROL = replace(_CONTROL, modes={"far": CONTROL_FAR, "null": CONTROL_NULL})
