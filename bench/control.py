"""Measures the latency of messages between two services, one-way and round trip, on MQTT and Zenoh in turn."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import fmean, median
from typing import Any, NamedTuple

import msgspec

from pebble.bench import control_far as far
from pebble.bench import null
from pebble.bench.aims import outcome, rounds_with_lost
from pebble.bench.comparison import Budget, Case, Comparison, Option, Run, of_known, rounds, seconds, variants
from pebble.bench.control_worker import ONE_WAY, PICTURES_HZ, ROUND_TRIP, SMALLEST, Slice, SliceSpec, condition
from pebble.bench.engine import roles_of
from pebble.bench.pictures import ecdf, null_ratios, ratios
from pebble.bench.ratios import Interval, paired
from pebble.bench.results import Cell, Judged, Value, percentile, rounded
from pebble.bench.tables import Column, Grid, figure, percentile_column, single_column
from pebble.bench.usage import wake_up_us, wake_ups
from pebble.rig.processes import BROKERS, OPERATORS, Processes, Program, Worker, python
from pebble.transports import MqttSettings, ZenohSettings

NONE, MEDIA, HOG = LOADS = ("none", "media", "hog")
AIM_P50, AIM_MEDIA_P99 = 0.70, 0.35
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
MQTT = tuple(name for name, variant in VARIANTS.items() if variant.kind != "zenoh")


class Participants(Processes):
    """The processes of each role: a broker or a hub, two ends, and a stream of pictures if that is one of the loads.

    They are ready when the ``with`` block begins.
    """

    def __init__(self, roles: Sequence[str], loads: Sequence[str]) -> None:
        super().__init__()
        self._roles, self._loads = roles, loads
        self._backbones: dict[str, Program] = {}
        self._workers: dict[str, list[Worker]] = {}  # sender, echo, writer and reader

    def start(self) -> None:
        for number, role in enumerate(self._roles):
            folder, variant = self.folder / str(number), VARIANTS[null.variant_of(role)]
            folder.mkdir()
            begin = self._hub if variant.kind == "zenoh" else self._broker
            self._backbones[role], settings, stream = begin(folder, variant)
            ends = {name: (variant.kind, _json(settings)) for name in ("sender", "echo")}
            streams = {name: stream for name in ("writer", "reader") if MEDIA in self._loads}
            self._workers[role] = [
                self.worker(f"{role}: {name}", "pebble.bench.control_worker", name, *where)
                for name, where in {**ends, **streams}.items()
            ]
        for worker in self.workers:
            worker.answer(_READY_S)

    def _hub(self, folder: Path, variant: Variant) -> tuple[Program, ZenohSettings, tuple[str, Path]]:
        run_dir = folder / "z"  # short, as the folder's name: paths of Unix sockets begin with it
        command = python("pebble.runtime.hub", _json(ZenohSettings(run_dir=run_dir)))
        hub = self.add(Program("hub", command, folder / "hub.log"), BROKERS)
        hub.wait_until((run_dir / "hub.sock").exists, _READY_S)
        return hub, ZenohSettings(run_dir=run_dir, **variant.settings), ("zenoh-shm", run_dir)

    def _broker(self, folder: Path, variant: Variant) -> tuple[Program, MqttSettings, tuple[str, int]]:
        broker = self.broker(extra=variant.broker, folder=folder)
        broker.wait()
        return broker, MqttSettings(host="127.0.0.1", port=broker.port, **variant.settings), ("mqtt", broker.port)

    def run(self, role: str, spec: SliceSpec, load: str) -> tuple[Slice, dict[str, float]]:
        """Runs one slice; returns its results, and the wake-ups in a round trip and pictures per second, by name.

        Raises PebbleError if a process ended, or no pictures flow.
        """
        sender, echo, *stream = self._workers[role]
        pids = {"wake_ups": [sender.pid, echo.pid], "broker_wake_ups": [self._backbones[role].pid]}
        if load == MEDIA:
            stream[0].ask("1", _ANSWER_S)
            begun = stream[1].ask("", _ANSWER_S)
        elif load == HOG:
            loop = ["sh", "-c", "while :; do :; done"]
            hog = self.add(Program("hog", loop, self.folder / "hog.log"), OPERATORS)
        before = {name: wake_ups(some) for name, some in pids.items()}
        done = msgspec.convert(sender.ask(_json(spec), spec.seconds + _ANSWER_S), Slice)
        used = {name: (wake_ups(some) - before[name]) / done.trips for name, some in pids.items()}
        if load == MEDIA:
            ended = stream[1].ask("", _ANSWER_S)
            stream[0].ask("0", _ANSWER_S)
            used["pictures_hz"] = (ended["pictures"] - begun["pictures"]) / (ended["s"] - begun["s"])
        elif load == HOG:
            self.end(hog)
        return done, used


def _json(what: MqttSettings | ZenohSettings | SliceSpec) -> str:
    return msgspec.json.encode(what, enc_hook=str).decode()


# -- what is measured, and shown


def conditions(run: Run) -> list[dict[str, Value]]:
    """With a load only the first size and the first rates."""
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
            replace(percentile_column(percent, f"{measure} p{percent}".replace(" ", "\n")), measure=measure)
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


# -- the assessment

_Key = tuple[str | None, str]  # variant and load
_ByKey = Mapping[_Key, Cell]


def _judged(cells: Sequence[Cell]) -> _ByKey:
    return {(cell.variant, str(cell.params["load"])): cell for cell in cells if _is_judged(cell)}


def wake_up_cost(_cells: Sequence[Cell]) -> Iterator[str]:
    same_us, other_us = wake_up_us()
    yield (
        f"Waking up a waiting process takes {same_us:.0f} us on the same core, {other_us:.0f} us on another; "
        "the last table counts the wake-ups of a round trip."
    )


def assessment(cells: Sequence[Cell]) -> Iterator[str | Judged]:
    """One sentence for each comparison that was measured, and the aims."""
    by_key = _judged(cells)
    best, best_loaded = _better(by_key, NONE, 50), _better(by_key, MEDIA, 99)
    compared: list[tuple[int, _Key, _Key]] = [
        (50, (P2P, NONE), (best, NONE)),
        (99, (P2P, MEDIA), (best_loaded, MEDIA)),
        (50, (HUB, NONE), (P2P, NONE)),
        *((percent, (name, HOG), (name, NONE)) for name in (P2P, best) for percent in (50, 99)),
        *((percent, (slow, NONE), (NODELAY, NONE)) for slow in ("paho", "mqtt") for percent in (50, 99)),
        (50, ("mqtt5", NONE), (NODELAY, NONE)),
    ]
    lines = [
        f"p{percent}: {interval.words(_name(ours), _name(theirs))}"
        for percent, ours, theirs in compared
        if (interval := _ratio(by_key, ours, theirs, percent)) is not None
    ]
    if lines:
        yield f"One way, 40 B at 200 Hz; {P2P} is compared with the better MQTT variant."
    yield from lines
    rates = {cell.variant: figure(cell.single("pictures_hz")) for (_, load), cell in by_key.items() if load == MEDIA}
    if rates:
        shown = ", ".join(f"{name} {rate}" for name, rate in rates.items())
        yield f"With media, pictures received per second, of {PICTURES_HZ:g}: {shown}"
    yield from _aims(by_key)


def _name(key: _Key) -> str:
    return str(key[0]) if key[1] == NONE else f"{key[0]} with {key[1]}"


def _better(by_key: _ByKey, load: str, percent: float) -> str | None:
    """The MQTT variant with the lowest percentile."""
    there = [by_key[name, load] for name in MQTT if (name, load) in by_key and by_key[name, load].samples]
    return min(there, key=lambda cell: cell.percentile(percent)).variant if there else None


def _ratio(by_key: _ByKey, ours: _Key, theirs: _Key, percent: float) -> Interval | None:
    """None if one of the two was not measured."""
    if ours not in by_key or theirs not in by_key:
        return None
    return paired(by_key[ours].rounds, by_key[theirs].rounds, percent)


def _aims(by_key: _ByKey) -> Iterator[Judged]:
    """The aim for p50 applies to the upper end of the interval, the one for p99 to the ratio, as they were set.

    If too many messages were lost in total, the aim is missed even if few rounds lost them.
    """
    by_key = {key: msgspec.structs.replace(cell, rounds=rounds_with_lost(cell)) for key, cell in by_key.items()}
    without = _ratio(by_key, (P2P, NONE), (_better(by_key, NONE, 50), NONE), 50)
    if without is not None:
        yield _aim(f"{P2P} / better MQTT, p50, upper end of the interval", without.high, AIM_P50, without)
    media = _ratio(by_key, (P2P, MEDIA), (_better(by_key, MEDIA, 99), MEDIA), 99)
    if media is not None:
        value = media.ratio if math.isfinite(by_key[P2P, MEDIA].percentile(99)) else math.inf
        yield _aim(f"{P2P} / better MQTT with media, p99", value, AIM_MEDIA_P99, media)


def _aim(what: str, value: float, aim: float, interval: Interval) -> Judged:
    """A ratio that is equal to 1 within noise does not meet an aim."""
    why = f" of {interval.rounds} rounds" if interval.few else ", too much was lost" if math.isinf(value) else ""
    met = outcome(value <= aim and not interval.equal, judged=not interval.few)
    return Judged(what=f"{what}, at most {aim:.2f}", outcome=met, measured=f"{interval}{why}")


# -- the declarations

_list = partial(Option, many=True, recorded=False)
_OPTIONS = (
    variants(tuple(VARIANTS)),
    _list(name="sizes", kind=int, least=SMALLEST, most=1 << 20, metavar="BYTES", help="Bytes, for example 40,1024."),
    _list(name="rates", kind=float, least=1, most=2000, metavar="HZ", help="Messages a second, for example 20,200."),
    Option(name="loads", many=True, known=LOADS, metavar="NAMES", help="Some of none, media and hog."),
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
    conditions=far.conditions,
    prepare=far.prepare,
    environment=far.environment,
    measure=far.measure,
    figures=far.JOINED,
    tables=(far.TABLE,),
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
    full=Budget(700, **_ALL, seconds=0.35, rounds=10, passes=2, fresh_every=1),
    quick=Budget(40, **_ONE, loads=[NONE, MEDIA], seconds=0.3, rounds=4, passes=1, fresh_every=2),
    variants=tuple(VARIANTS),
    conditions=conditions,
    environment=lambda run: Participants(roles_of(run), run["loads"]),
    measure=measure,
    measures=(ONE_WAY, ROUND_TRIP),
    figures={
        "late": sum,
        **dict.fromkeys(("call_us", "fabric_us", "inbox_us"), of_known(median, 1)),
        **dict.fromkeys(("wake_ups", "broker_wake_ups", "pictures_hz"), of_known(fmean, 1)),
    },
    tables=(TABLE, HOPS),
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
    full=Budget(180, **_ONE, loads=[NONE], null=True, seconds=0.3, rounds=30, passes=2, fresh_every=1),
    quick=Budget(10, seconds=0.25, rounds=4, passes=1, fresh_every=2),
    is_null=True,
    variants=(P2P,),
    tables=(replace(TABLE, baseline=""), HOPS),
    assessment=(null.assessment,),
    words=("bench", "control"),
    reported=("--null",),
    summary_lines=0,
    pictures=(null_ratios("Null test of control"), ecdf("Null test of control")),
)
CONTROL = replace(_CONTROL, modes={"far": CONTROL_FAR, "null": CONTROL_NULL})
