"""Measures the latency of messages between two services, on MQTT and Zenoh in turn.

One process sends periodically, another returns each message at once; both work as services do with drive commands, and
use their QoS. The latency is from just before the publish call until the other's handler runs. Every round starts new
processes, and a broker or hub for each variant. A slice is what one variant sends under one condition; those of all
variants run directly after each other, in either order. Messages of the first 0.1 s of a slice do not count,
those that do not return within a second of the last one are lost. ``media``: pictures of 640x480 flow at 30 Hz through
the same broker or shared memory.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

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
ONE_WAY = "one-way"
BASELINE: Final = "mqtt"
_READY_S = 40.0
_ANSWER_S = 30.0  # in addition to the slice itself


#: By variant: the transport between the two services, or the stand-in, which is stock paho at both ends.
VARIANTS: Final = {STAND_IN: STAND_IN, "mqtt": "mqtt", "zenoh-p2p": "zenoh"}


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
    charts = plots.curves("control-one-way", "Service to service, one way", results.cells)
    return Shown(results, [table(results)], charts)


def measure(settings: Settings, number: int, progress: Progress) -> Iterator[Cell]:
    """Yield the results of one round: some passes through all cases and variants, every other one backwards."""
    with Participants(settings.variants) as participants:
        for pass_ in range(settings.passes):
            for case in in_turn(settings.cases, number + pass_):
                for variant in in_turn(settings.variants, number + pass_):
                    progress(f"{variant}, {', '.join(map(str, case.params().values()))}")
                    done = participants.run(variant, case, settings.seconds)
                    yield round_cell(variant, ONE_WAY, "us", done.latencies_us, case.params(), sent=done.sent)


def table(results: Results) -> Table:
    """Return the latencies of each variant under each condition."""
    grid = plain_table(
        "Latency one way, µs; the ratio is that of medians",
        ["size", "rate", "load", "variant", "p50", "p99", "lost", f"to {BASELINE}"],
        left=4, caption=f"{STAND_IN}: stock paho at both ends. {RATIOS}",
    )  # fmt: skip
    for cells in grouped(results.cells, lambda cell: tuple(cell.params.values())).values():
        grid.add_section()
        for number, ours in enumerate(sorted(cells, key=lambda cell: list(VARIANTS).index(cell.variant))):
            condition = ("", "", "") if number else ours.params.values()
            base = results.find(BASELINE, ONE_WAY, **ours.params)
            figures = (*percentiles(ours, 50, 99), str(ours.lost), compared(ours, base))
            grid.add_row(*map(str, condition), ours.variant, *figures)
    return grid


class Participants(Processes):
    """The processes of each variant: a broker or hub, and two ends. They are ready when the ``with`` block begins."""

    def __init__(self, variants: Sequence[str]) -> None:
        super().__init__()
        self._variants = variants
        self._senders: dict[str, Worker] = {}  # by variant
        self._where: dict[str, object] = {}  # by variant: the folder for sockets, or the broker's port

    def start(self) -> None:
        """Start the broker or hub and both ends of each variant; wait until all are ready."""
        for number, variant in enumerate(self._variants):
            folder, kind = self.folder / str(number), VARIANTS[variant]
            folder.mkdir()
            settings: MqttSettings | ZenohSettings
            if kind == "zenoh":
                settings = ZenohSettings(run_dir=folder / "z")  # a short name: the path of a Unix socket is limited
                command = python("pebble.extensions.lab.rig.hub", _json(settings))
                hub = self.add(Program("hub", command, folder / "hub.log"), BROKERS)
                hub.wait_until((settings.run_dir / "hub.sock").exists, _READY_S)
                self._where[variant] = settings.run_dir
            else:
                broker = self.broker(folder=folder)
                broker.wait()
                settings = MqttSettings(host="127.0.0.1", port=broker.port)
                self._where[variant] = broker.port
            for role in ("sender", "echo"):
                options = (role, kind, _json(settings))
                worker = self.worker(f"{variant}: {role}", "pebble.extensions.lab.bench.control_ends", *options)
                if role == "sender":
                    self._senders[variant] = worker
        for worker in self.workers:
            worker.answer(_READY_S)

    def run(self, variant: str, case: Case, seconds: float) -> Slice:
        """Run one slice; return its results. Raises PebbleError if a process ended, or no pictures flow."""
        picture_variant = "zenoh-shm" if VARIANTS[variant] == "zenoh" else "mqtt"
        picture_ends: dict[str, Worker] = {}
        for role in ("reader", "writer") if case.load == MEDIA else ():
            options = (picture_variant, role, self._where[variant], "640x480")
            picture_ends[role] = self.worker(role, "pebble.extensions.lab.bench.frames_worker", *options)
        for end in picture_ends.values():
            end.answer(_READY_S)
        began_ns = time.monotonic_ns()
        spec = _json(SliceSpec(case.size, case.rate, seconds))
        done = msgspec.convert(self._senders[variant].ask(spec, seconds + _ANSWER_S), Slice)
        if case.load == MEDIA:
            pictures = picture_ends["reader"].ask("", _ANSWER_S)["arrived"]
            if not any(arrived_ns > began_ns for _, arrived_ns in pictures):
                raise PebbleError(f"{variant}: no pictures flow")
        if problems := self.unexpected_exits():
            raise PebbleError(f"{variant}: {'; '.join(problems)}")
        for end in picture_ends.values():
            self.end(end)
        return done


def _json(settings: MqttSettings | ZenohSettings | SliceSpec) -> str:
    return msgspec.json.encode(settings, enc_hook=str).decode()
