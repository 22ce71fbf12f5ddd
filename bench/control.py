"""Measures the latency of messages between two services, one-way and round trip, on MQTT and Zenoh in turn."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from statistics import fmean, median
from typing import Any

from pebble.bench import control_far as far
from pebble.bench import null
from pebble.bench.comparison import Budget, Case, Combine, Comparison, Option, Run, of_known, rounds, seconds, variants
from pebble.bench.control_ends import ONE_WAY, ROUND_TRIP, SMALLEST, SliceSpec, rate_name, size_name
from pebble.bench.control_participants import LOADS, MEDIA, NONE, P2P, VARIANTS, Participants
from pebble.bench.control_report import assessment, legend, tables, wake_up_cost
from pebble.bench.engine import roles_of
from pebble.bench.pictures import ecdf, null_ratios, ratios
from pebble.bench.results import Cell, Value, percentile, rounded

SIZES = (40, 1024)
RATES = (20.0, 200.0, 1000.0)
LOADED_SIZE, LOADED_RATES = 40, (20.0, 200.0)  # with a load, unless given
_LARGEST, _FASTEST = 1 << 20, 2000.0


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


_JOINED: Mapping[str, Combine] = {
    "late": sum,
    **dict.fromkeys(("call_us", "fabric_us", "inbox_us"), of_known(median, 1)),
    **dict.fromkeys(
        ("cpu_percent", "broker_cpu_percent", "wake_ups", "broker_wake_ups", "pictures_hz"), of_known(fmean, 1)
    ),
}
_OPTIONS = (
    variants(tuple(VARIANTS)),
    Option(
        name="sizes", kind=int, many=True, least=SMALLEST, most=_LARGEST, metavar="BYTES", recorded=False,
        help="Bytes, for example 40,1024.",
    ),
    Option(
        name="rates", kind=float, many=True, least=1, most=_FASTEST, metavar="HZ", recorded=False,
        help="Messages a second, for example 20,200.",
    ),
    Option(
        name="loads", many=True, known=LOADS, metavar="NAMES", recorded=False, help="Some of none, media and hog."
    ),
    seconds("Duration of one case in a round."),
    rounds("Rounds of all cases."),
    Option(
        name="null", kind=bool, recorded=False, help="One variant against itself, and against itself slowed by a fifth."
    ),
    Option(
        name="far", metavar="URL", private=True, help="Measure against `pebble bench echo` on another machine."
    ),
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
