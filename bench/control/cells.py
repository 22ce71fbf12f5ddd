"""Measures the latency of messages between two services, one-way and round trip, on MQTT and Zenoh in turn."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from statistics import fmean, median
from typing import Any, NamedTuple

import msgspec

from pebble.bench.comparison import (
    Budget,
    Case,
    Comparison,
    Measuring,
    Option,
    Report,
    Run,
    of_known,
    rounds,
    seconds,
    variants,
)
from pebble.bench.control import far
from pebble.bench.control.ends import ONE_WAY, ROUND_TRIP, SMALLEST, Slice, SliceSpec, condition
from pebble.bench.engine import roles_of
from pebble.bench.judging import null
from pebble.bench.judging.aims import outcome, rounds_with_lost
from pebble.bench.judging.ratios import Interval, paired
from pebble.bench.pictures import ecdf, null_ratios, ratios
from pebble.bench.results import Cell, Judged, Value, percentile, rounded
from pebble.bench.tables import Column, Grid, percentile_column, single_column
from pebble.bench.usage import wake_ups
from pebble.errors import PebbleError
from pebble.rig.processes import BROKERS, OPERATORS, Processes, Program, Worker, python
from pebble.transports import MqttSettings, ZenohSettings

NONE, MEDIA, HOG = LOADS = ("none", "media", "hog")
_JUDGED = condition(40, 200)
_LOADED_RATES = 2  # the first ones
_READY_S = 40.0
_ANSWER_S = 30.0  # in addition to the slice itself


class Variant(NamedTuple):
    kind: str  # a transport, or ``paho``
    settings: Mapping[str, Any] = {}
    broker: Sequence[str] = ()  # lines of mosquitto's configuration


_NODELAY = ("set_tcp_nodelay true",)
VARIANTS = {
    "paho": Variant("paho"),  # at both ends
    "mqtt": Variant("mqtt"),
    "mqtt-nodelay": Variant("mqtt", broker=_NODELAY),
    "mqtt5": Variant("mqtt", {"protocol": "5"}, _NODELAY),
    "zenoh-p2p": Variant("zenoh"),
    "zenoh-hub": Variant("zenoh", {"client": True}),  # everything goes through the hub
}
P2P, HUB, NODELAY = "zenoh-p2p", "zenoh-hub", "mqtt-nodelay"


class Participants(Processes):
    """The processes of each role: a broker or a hub, and two ends, which are ready when the ``with`` block begins."""

    def __init__(self, roles: Sequence[str]) -> None:
        super().__init__()
        self._roles = roles
        #: By role: broker or hub, where pictures flow (as frames_worker names it), sender and echo.
        self._parts: dict[str, tuple[Program, tuple[str, object], list[Worker]]] = {}

    def start(self) -> None:
        for number, role in enumerate(self._roles):
            folder, (kind, settings, lines) = self.folder / str(number), VARIANTS[null.variant_of(role)]
            folder.mkdir()
            if kind == "zenoh":
                where: Any = ZenohSettings(run_dir=folder / "z", **settings)  # short: paths of Unix sockets
                own = _json(ZenohSettings(run_dir=where.run_dir))
                backbone = self.add(Program("hub", python("pebble.runtime.hub", own), folder / "hub.log"), BROKERS)
                backbone.wait_until((where.run_dir / "hub.sock").exists, _READY_S)
                stream: tuple[str, object] = ("zenoh-shm", where.run_dir)
            else:
                backbone = broker = self.broker(extra=lines, folder=folder)
                broker.wait()
                where = MqttSettings(host="127.0.0.1", port=broker.port, **settings)
                stream = ("mqtt", broker.port)
            ends = [
                self.worker(f"{role}: {name}", "pebble.bench.control.ends", name, kind, _json(where))
                for name in ("sender", "echo")
            ]
            self._parts[role] = backbone, stream, ends
        for worker in self.workers:
            worker.answer(_READY_S)

    def run(self, role: str, spec: SliceSpec, load: str) -> tuple[Slice, dict[str, float]]:
        """Runs one slice; returns its results, and the wake-ups in a round trip and pictures per second, by name.

        Raises PebbleError if a process ended, or no pictures flow.
        """
        backbone, stream, (sender, echo) = self._parts[role]
        beside = self._begin(load, *stream)
        pids = {"wake_ups": [sender.pid, echo.pid], "broker_wake_ups": [backbone.pid]}
        before, began_ns = {name: wake_ups(some) for name, some in pids.items()}, time.monotonic_ns()
        if load == MEDIA:
            beside[0].send(f"{began_ns} {1 << 62}")
        done = msgspec.convert(sender.ask(_json(spec), spec.seconds + _ANSWER_S), Slice)
        used = {name: (wake_ups(some) - before[name]) / done.trips for name, some in pids.items()}
        if load == MEDIA:
            pictures = beside[0].ask("", _ANSWER_S)["latencies_us"]
            used["pictures_hz"] = 1e9 * len(pictures) / (time.monotonic_ns() - began_ns)
            if not pictures:
                raise PebbleError(f"{role}: no pictures flow")
        if problems := self.unexpected_exits():
            raise PebbleError(f"{role}: {'; '.join(problems)}")
        for program in beside:
            self.end(program)
        return done, used

    def _begin(self, load: str, kind: str, where: object) -> Sequence[Any]:
        """Starts the load: nothing, a busy loop, or a reader and a writer of pictures, which flow afterwards."""
        if load == HOG:
            loop = ["sh", "-c", "while :; do :; done"]
            return [self.add(Program("hog", loop, self.folder / "hog.log"), OPERATORS)]
        names = ("reader", "writer") if load == MEDIA else ()
        ends = [self.worker(name, "pebble.bench.frames_worker", kind, name, where, "640x480", 0) for name in names]
        for end in ends:
            end.answer(_READY_S)
        return ends


def _json(what: MqttSettings | ZenohSettings | SliceSpec) -> str:
    return msgspec.json.encode(what, enc_hook=str).decode()


# -- what is measured, and shown


def conditions(run: Run) -> list[dict[str, Value]]:
    """Only the first size and the first rates are measured with a load."""
    return [
        {**condition(size, rate), "load": load}
        for load in run["loads"]
        for size in run["sizes"]
        for rate in run["rates"]
        if load == NONE or (size == run["sizes"][0] and rate in run["rates"][:_LOADED_RATES])
    ]


def measure(case: Case) -> Iterator[Cell]:
    """One slice, in us. The null test uses only the one-way times, since its slowdown is a fifth of them."""
    done, used = case.env.run(case.role, SliceSpec.of(case), str(case.condition["load"]))
    hops = {
        "call_us": done.calls_ns,
        "fabric_us": [one.transport_ns - one.t3 for one in done.exchanges],  # until the near transport has the reply
        "inbox_us": [one.t4 - one.transport_ns for one in done.exchanges],  # from then until its handler runs
    }
    medians = {name: rounded(percentile(times, 50) / 1000, 1) for name, times in hops.items()}
    figures = {"sent": done.sent, "late": done.late, **medians, **used}
    yield case.cell(ONE_WAY, "us", [(one.t2 - one.t1) / 1000 for one in done.exchanges], **figures)
    if not case.run.comparison.is_null:
        yield case.cell(ROUND_TRIP, "us", [(one.t4 - one.t1) / 1000 for one in done.exchanges], **figures)


def _is_judged(cell: Cell) -> bool:
    return cell.measure == ONE_WAY and _JUDGED.items() <= cell.params.items()


TABLE = Grid(
    title="latency, us; the ratio is one-way",
    rows=("size", "rate", "load", "variant"),
    columns=(
        *(
            percentile_column(percent, f"{measure} p{percent}".replace(" ", "\n"), measure)
            for measure in (ONE_WAY, ROUND_TRIP)
            for percent in (50, 99)
        ),
        Column("lost/\nlate", lambda cell: f"{cell.lost}/{cell.figures['late']}"),
    ),
    baseline="mqtt",
)
HOPS = Grid(
    title="where the time goes: {size} at {rate}, unloaded, medians, us",
    rows=("variant",),
    columns=(
        single_column("publish\ncall", "call_us", ".1f"),
        single_column("thread\nhas it", "fabric_us", ".1f"),
        single_column("handler\nruns", "inbox_us", ".1f"),
        single_column("wake-ups:\nends", "wake_ups", ".1f"),
        single_column("broker\nor hub", "broker_wake_ups", ".1f"),
    ),
    of=lambda cell: _is_judged(cell) and cell.params["load"] == NONE,
    each=("size", "rate"),
)


# -- the assessment, of 40 B at 200 Hz, one way

_Key = tuple[str, str]  # variant and load
_Compared = tuple[int, _Key, _Key]  # a percentile, and whose to whose
BETTER = "better MQTT"  # the variant with the lowest percentile
#: What is judged, the bound, and whether it is one of the interval's upper end or of the ratio, as it was set.
AIMS: Mapping[_Compared, tuple[str, float, str]] = {
    (50, (P2P, NONE), (BETTER, NONE)): (f"{P2P} / {BETTER}, p50, upper end of the interval", 0.70, "high"),
    (99, (P2P, MEDIA), (BETTER, MEDIA)): (f"{P2P} / {BETTER} with media, p99", 0.35, "ratio"),
}
_COMPARED: Sequence[_Compared] = (
    *AIMS,
    (50, (HUB, NONE), (P2P, NONE)),
    *((percent, (P2P, HOG), (P2P, NONE)) for percent in (50, 99)),
    *((percent, (slow, NONE), (NODELAY, NONE)) for slow in ("paho", "mqtt") for percent in (50, 99)),
    (50, ("mqtt5", NONE), (NODELAY, NONE)),
)


def assessment(cells: Sequence[Cell]) -> Iterator[str | Judged]:
    """A sentence for each comparison that was measured, and the aims. Lost messages are infinitely late."""
    found = {
        (cell.variant, str(cell.params["load"])): msgspec.structs.replace(cell, rounds=rounds_with_lost(cell))
        for cell in cells
        if _is_judged(cell)
    }
    for percent, _, (_, load) in AIMS:
        mqtt = [found[key] for key in found if key[1] == load and VARIANTS[key[0]].kind != "zenoh"]
        if mqtt:
            found[BETTER, load] = min(mqtt, key=lambda cell: cell.percentile(percent))
    intervals = {
        (percent, ours, theirs): paired(found[ours].rounds, found[theirs].rounds, percent)
        for percent, ours, theirs in _COMPARED
        if ours in found and theirs in found
    }
    if intervals:
        yield f"One way, 40 B at 200 Hz; {P2P} is compared with the better MQTT variant."
    for (percent, *both), interval in intervals.items():
        names = (found[key].variant + (f" with {key[1]}" if key[1] != NONE else "") for key in both)
        yield f"p{percent}: {interval.words(*names)}"
    streams = {name: cell.single("pictures_hz") for (name, load), cell in found.items() if load == MEDIA}
    if rates := ", ".join(f"{name} {rate:.1f}" for name, rate in streams.items() if name != BETTER):
        yield f"With media, pictures received per second, of 30: {rates}"
    for compared, (what, bound, of) in AIMS.items():
        if compared in intervals:
            yield _judged(what, bound, found[compared[1]].percentile(compared[0]), intervals[compared], of)


def _judged(what: str, bound: float, percentile_us: float, interval: Interval, of: str) -> Judged:
    """Too much that was lost in total misses an aim, even in few rounds; so does a ratio equal to 1 within noise."""
    value = getattr(interval, of) if math.isfinite(percentile_us) else math.inf
    why = f" of {interval.rounds} rounds" if interval.few else ", too much was lost" if math.isinf(value) else ""
    met = outcome(value <= bound and not interval.equal, judged=not interval.few)
    return Judged(what=f"{what}, at most {bound:.2f}", outcome=met, measured=f"{interval}{why}")


# -- the declarations

_list = partial(Option, many=True, recorded=False)
_OPTIONS = (
    variants(tuple(VARIANTS)),
    _list(name="sizes", kind=int, least=SMALLEST, most=1 << 20, metavar="BYTES", help="Bytes, for example 40,1024."),
    _list(name="rates", kind=float, least=1, most=2000, metavar="HZ", help="Messages a second, for example 20,200."),
    Option(name="loads", many=True, known=LOADS, metavar="NAMES", help="Some of none, media and hog."),
    seconds("Duration of one case in a round."),
    rounds("Rounds of all cases."),
    Option(name="null", kind=bool, recorded=False, help="One variant against itself, also slowed by a fifth."),
    Option(name="far", metavar="URL", private=True, help="Measure against `pebble bench echo` on another machine."),
)
_ONE = {"sizes": [40], "rates": [200.0]}
_ALL = {"sizes": [40, 1024], "rates": [20.0, 200.0, 1000.0], "loads": LOADS}

CONTROL_FAR = Comparison(
    name="control-far",
    title="Between two machines",
    what="Round trips to an echo on another machine, and one-way times as precise as the two clocks allow.",
    options=_OPTIONS,
    full=Budget(  # one connection for all rounds
        90, sizes=[40, 1024], rates=[20.0, 200.0], loads=None, seconds=2.0, rounds=10, fresh_every=10_000
    ),
    quick=Budget(5, **_ONE, seconds=1.0, rounds=4),
    variants=(far.VARIANT,),
    conditions=lambda run: [condition(size, rate) for size in run["sizes"] for rate in run["rates"]],
    measuring=Measuring(
        prepare=far.prepare,
        environment=far.environment,
        measure=far.measure,
        figures={"late": sum, "clock_offset_ms": of_known(median, 6), "clock_error_ms": of_known(max, 6)},  # to ns
    ),
    report=Report(
        tables=(far.TABLE,),
        complete=lambda cells: all(cell.samples for cell in cells if cell.measure == ROUND_TRIP),
        reported=None,
        pictures=(ecdf("Control far"),),
    ),
    words=("bench", "control"),
)
_CONTROL = Comparison(
    name="control",
    title="Service to service",
    what="A message of a drive command's size goes from one process to another and back, as between a robot's "
    "services: unloaded, with camera frames on the same transport, and beside a process that uses a whole core. "
    "One-way is from just before the publish call until the receiver's handler runs; both ends use the same clock.",
    help="""Round trips between two services: MQTT and Zenoh; unloaded, with camera frames, beside a busy process.

    Each round starts two processes and a broker or hub for each variant. Needs mosquitto.
    With --null: one variant (zenoh-p2p), 40 B at 200 Hz.

    \b
        pebble bench control
        pebble bench control --variants mqtt,zenoh-p2p --sizes 40 --rates 200 --rounds 20
        pebble bench control --null --variants mqtt
        pebble bench control --far mqtt://broker.local
    """,
    options=_OPTIONS,
    full=Budget(700, **_ALL, seconds=0.35, rounds=10, passes=2, fresh_every=1),
    quick=Budget(40, **_ONE, loads=[NONE, MEDIA], seconds=0.3, rounds=4, passes=1, fresh_every=2),
    variants=tuple(VARIANTS),
    conditions=conditions,
    measuring=Measuring(
        environment=lambda run: Participants(roles_of(run)),
        measure=measure,
        measures=(ONE_WAY, ROUND_TRIP),
        figures={
            "late": sum,
            **dict.fromkeys(("call_us", "fabric_us", "inbox_us"), of_known(median, 1)),
            **dict.fromkeys(("wake_ups", "broker_wake_ups", "pictures_hz"), of_known(fmean, 1)),
        },
    ),
    report=Report(
        tables=(TABLE, HOPS),
        assessment=(assessment,),
        pictures=(ecdf("Service to service"), ratios("Service to service", "mqtt")),
    ),
)
CONTROL_NULL = _CONTROL.null_test(
    "One variant against itself, and against itself with a fifth of its usual latency planted by the sender. "
    "The first interval must include 1.00, the second must lie above it; otherwise the comparison above finds "
    "differences that do not exist, or misses some that do.",
    full=Budget(120, **_ONE, loads=[NONE], null=True, seconds=0.3, rounds=30, passes=2, fresh_every=1),
    quick=Budget(10, seconds=0.25, rounds=4, passes=1, fresh_every=2),
    variants=(P2P,),
    report={
        "tables": (replace(TABLE, baseline=""), HOPS),
        "pictures": (null_ratios("Null test of control"), ecdf("Null test of control")),
    },
)
CONTROL = replace(_CONTROL, modes={"far": CONTROL_FAR, "null": CONTROL_NULL})
