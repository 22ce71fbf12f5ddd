"""Measures the latency of messages between two services, one-way and round trip, on MQTT and Zenoh in turn.

One process sends periodically, another returns each message at once; both work as services do with drive commands, and
use their QoS. One-way is from just before the publish call until the receiver's handler runs, a round trip until the
sender's. Every round starts new processes, and a broker or hub for each variant; a slice of each variant under the same
condition runs directly after the other, in either order. Messages of the first 0.1 s do not count, those that do not
return within a second of the last one are lost. ``media``: pictures of 640x480 flow at 30 Hz through the same broker or
shared memory.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import msgspec
from rich.console import Console
from rich.table import Table

from pebble.errors import PebbleError
from pebble.extensions.lab.bench import plots
from pebble.extensions.lab.bench.control_ends import Slice, SliceSpec
from pebble.extensions.lab.bench.results import STAND_IN, Cell, Params, Results, begin, grouped, round_cell
from pebble.extensions.lab.bench.rounds import Progress, in_turn, measure_rounds
from pebble.extensions.lab.bench.show import RATIOS, Shown, compared, percentiles, plain_table
from pebble.extensions.lab.rig.processes import BROKERS, Processes, Program, Worker, python
from pebble.transports import MqttSettings, ZenohSettings

NONE, MEDIA = "none", "media"  # loads
ONE_WAY, ROUND_TRIP = "one-way", "round trip"
BASELINE: Final = "mqtt"
_READY_S = 40.0
_ANSWER_S = 30.0  # in addition to the slice itself


class Variant(NamedTuple):
    """A transport between two services."""

    kind: str  # a transport, or the stand-in
    settings: Mapping[str, Any] = {}
    broker: Sequence[str] = ()  # lines of mosquitto's configuration


_NODELAY = ("set_tcp_nodelay true",)
VARIANTS: Final = {
    STAND_IN: Variant(STAND_IN),  # stock paho at both ends
    "mqtt": Variant("mqtt"),
    "mqtt-nodelay": Variant("mqtt", broker=_NODELAY),
    "mqtt5": Variant("mqtt", {"protocol": "5"}, _NODELAY),
    "zenoh-p2p": Variant("zenoh"),
    "zenoh-hub": Variant("zenoh", {"client": True}),  # everything goes through the hub
}


class Case(NamedTuple):
    """A message size and rate, with a load beside it."""

    size: int  # bytes
    rate: int  # Hz
    load: str = NONE

    def params(self) -> Params:
        return {"size": f"{self.size} B", "rate": f"{self.rate} Hz", "load": self.load}


@dataclass(frozen=True, slots=True)
class Settings:
    """The variants and cases: ``seconds`` of each case in each of the ``passes`` of a round."""

    variants: Sequence[str] = tuple(VARIANTS)
    cases: Sequence[Case] = (Case(40, 20), Case(40, 200), Case(40, 1000), Case(1024, 200), Case(40, 200, MEDIA))
    seconds: float = 0.35
    rounds: int = 10
    passes: int = 2


FULL: Final = Settings()
QUICK: Final = Settings(cases=(Case(40, 200), Case(40, 200, MEDIA)), seconds=0.3, rounds=3, passes=1)


def run(settings: Settings, console: Console) -> Shown:
    """Measure all variants. Raises PebbleError."""
    results = begin("control", settings)
    measure_rounds(results, settings.rounds, lambda number, progress: measure(settings, number, progress), console)
    one_way = [cell for cell in results.cells if cell.measure == ONE_WAY]
    return Shown(results, [table(results)], plots.curves("control-one-way", "Service to service, one way", one_way))


def measure(settings: Settings, number: int, progress: Progress) -> Iterator[Cell]:
    """Yield the results of one round; every other pass goes backwards."""
    with Participants(settings.variants) as participants:
        for pass_ in range(settings.passes):
            for case in in_turn(settings.cases, number + pass_):
                for variant in in_turn(settings.variants, number + pass_):
                    progress(f"{variant}, {', '.join(map(str, case.params().values()))}")
                    done, pictures_hz = participants.run(variant, case, settings.seconds)
                    figures = {"sent": done.sent, "late": done.late, "pictures_hz": pictures_hz}
                    one_way = [(exchange.echoed_ns - exchange.sent_ns) / 1000 for exchange in done.exchanges]
                    round_trip = [(exchange.received_ns - exchange.sent_ns) / 1000 for exchange in done.exchanges]
                    yield round_cell(variant, ONE_WAY, "us", one_way, case.params(), **figures)
                    yield round_cell(variant, ROUND_TRIP, "us", round_trip, case.params(), **figures)


def table(results: Results) -> Table:
    """Return the latencies of each variant under each condition."""
    grid = plain_table(
        "Latency, µs; the ratio is that of one-way medians",
        ["size", "rate", "load", "variant", "one way\np50", "p99", "round trip\np50", "p99", "lost", "late", "media Hz",
         f"to {BASELINE}"],
        left=4, caption=f"{STAND_IN}: stock paho at both ends. {RATIOS}",
    )  # fmt: skip
    for cells in grouped(results.cells, lambda cell: tuple(cell.params.values())).values():
        grid.add_section()
        one_way = [cell for cell in cells if cell.measure == ONE_WAY]
        for at, ours in enumerate(sorted(one_way, key=lambda cell: list(VARIANTS).index(cell.variant))):
            place = ours.params.values() if at == 0 else ("", "", "")
            back = results.find(ours.variant, ROUND_TRIP, **ours.params) or ours
            base = results.find(BASELINE, ONE_WAY, **ours.params)
            pictures = f"{ours.middle('pictures_hz'):.1f}" if ours.params["load"] == MEDIA else ""
            grid.add_row(
                *map(str, place), ours.variant, *percentiles(ours, 50, 99), *percentiles(back, 50, 99), str(ours.lost),
                str(ours.total("late")), pictures, compared(ours, base),
            )  # fmt: skip
    return grid


class Participants(Processes):
    """The processes of each variant: a broker or hub, and two ends. They are ready when the ``with`` block begins."""

    def __init__(self, variants: Sequence[str]) -> None:
        super().__init__()
        self._variants = variants
        #: By variant: how frames_worker names where pictures flow, and the sender.
        self._parts: dict[str, tuple[tuple[str, object], Worker]] = {}

    def start(self) -> None:
        for number, variant in enumerate(self._variants):
            folder, (kind, settings, lines) = self.folder / str(number), VARIANTS[variant]
            folder.mkdir()
            if kind == "zenoh":
                where: Any = ZenohSettings(run_dir=folder / "z", **settings)  # short: paths of Unix sockets
                hub_settings = _json(ZenohSettings(run_dir=where.run_dir))
                hub = self.add(
                    Program("hub", python("pebble.extensions.lab.rig.hub", hub_settings), folder / "hub.log"), BROKERS
                )
                hub.wait_until((where.run_dir / "hub.sock").exists, _READY_S)
                stream: tuple[str, object] = ("zenoh-shm", where.run_dir)
            else:
                broker = self.broker(extra=lines, folder=folder)
                broker.wait()
                where = MqttSettings(host="127.0.0.1", port=broker.port, **settings)
                stream = ("mqtt", broker.port)
            sender, _ = (
                self.worker(f"{variant}: {name}", "pebble.extensions.lab.bench.control_ends", name, kind, _json(where))
                for name in ("sender", "echo")
            )
            self._parts[variant] = stream, sender
        for worker in self.workers:
            worker.answer(_READY_S)

    def run(self, variant: str, case: Case, seconds: float) -> tuple[Slice, float]:
        """Run one slice; return its results, and the pictures per second during it.

        Raises PebbleError if a process ended, or no pictures flow.
        """
        stream, sender = self._parts[variant]
        ends = [
            self.worker(name, "pebble.extensions.lab.bench.frames_worker", stream[0], name, stream[1], "640x480")
            for name in (("reader", "writer") if case.load == MEDIA else ())
        ]
        for end in ends:
            end.answer(_READY_S)
        began_ns, pictures_hz = time.monotonic_ns(), 0.0
        spec = _json(SliceSpec(case.size, case.rate, seconds))
        done = msgspec.convert(sender.ask(spec, seconds + _ANSWER_S), Slice)
        for reader in ends[:1]:
            pictures = sum(ns > began_ns for _, ns in reader.ask("", _ANSWER_S)["arrived"])
            pictures_hz = 1e9 * pictures / (time.monotonic_ns() - began_ns)
            if not pictures:
                raise PebbleError(f"{variant}: no pictures flow")
        if problems := self.unexpected_exits():
            raise PebbleError(f"{variant}: {'; '.join(problems)}")
        for end in ends:
            self.end(end)
        return done, pictures_hz


def _json(settings: MqttSettings | ZenohSettings | SliceSpec) -> str:
    return msgspec.json.encode(settings, enc_hook=str).decode()
