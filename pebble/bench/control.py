"""How fast a drive command reaches the wheels, with and without pictures and sound flowing, on MQTT and on Zenoh.

From the operator's publish call to the last byte of the command's line at the MCU's pty: a remote broker, the bridge,
the robot's own transport, the serial bridge. Real processes, stock mosquitto, loopback.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from pebble.bench.control_operator import Operator
from pebble.bench.control_robot import BASE, Robot
from pebble.bench.figures import LONGEST_S, percentile, ratio, rounded
from pebble.bench.frames_process import Worker, end_workers
from pebble.bench.usage import cpu_s
from pebble.errors import PebbleError
from pebble.signals import interrupted_by_signals

KINDS = ("mqtt", "zenoh")
UNLOADED, LOADED = "none", "media"
_FLOWS = ("frames", "video", "audio")
_RATE_HZ = 20.0
_SETTLE_S = 3.0  # start-up work is over; media flow, or have stopped
_ARRIVE_S = 1.0  # a command that is later than that is lost
_MEDIA_START_S = 20.0
_ANSWER_S = 5.0
_LOOK_S = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """Rounds of ``seconds`` without media, and as many with them if asked for, in turn, on one robot per kind."""

    seconds: float = 10.0
    rounds: int = 3
    kinds: Sequence[str] = KINDS
    with_media: bool = False
    json: Path | None = None

    def check(self) -> None:
        """Raises PebbleError naming what makes no sense."""
        unknown = [kind for kind in self.kinds if kind not in KINDS]
        if unknown or not self.kinds:
            raise PebbleError(f"unknown transport {', '.join(unknown)}: there are {', '.join(KINDS)}")
        if not 0 < self.seconds <= LONGEST_S or self.rounds < 1:
            raise PebbleError(f"seconds and rounds must be positive, and seconds at most {LONGEST_S:.0f}")
        if self.json is not None and not self.json.resolve().parent.is_dir():
            raise PebbleError(f"{self.json}: there is no such folder")


@dataclass(slots=True, kw_only=True)
class Row:
    """One robot under one load, over all rounds."""

    kind: str
    load: str
    latencies_ms: list[float] = field(default_factory=list)
    sent: int = 0
    cpu: list[float] = field(default_factory=list)  # % of one core, the robot's processes together
    flowed: dict[str, float] = field(default_factory=dict)  # per second: frames, video, audio, and their bytes

    def percentile(self, percent: float) -> float:
        return percentile(self.latencies_ms, percent)

    def as_json(self) -> dict[str, Any]:
        figures = {"p50_ms": self.percentile(50), "p99_ms": self.percentile(99), "max_ms": self.percentile(100)}
        return {
            "variant": self.kind,
            "params": {"load": self.load},
            "n": len(self.latencies_ms),
            "lost": self.sent - len(self.latencies_ms),
            **{name: rounded(figure, 3) for name, figure in figures.items()},
            "cpu": rounded(percentile(self.cpu, 50), 1),
            **{f"{name}_per_s": round(rate, 1) for name, rate in self.flowed.items()},
        }


def run(plan: Plan, console: Console | None = None) -> int:
    """Measure and show; 0 if every row has figures. Raises PebbleError."""
    console = console or Console()
    plan.check()
    rows: list[Row] = []
    with interrupted_by_signals():
        for kind in plan.kinds:
            with console.status(f"{kind}: starting a robot") as status:
                rows += _measure(kind, plan, status.update)
    console.print(_table(rows))
    for line in ratios(rows):
        console.print(line, highlight=False)
    if plan.json is not None:
        plan.json.write_text(json.dumps({"rows": [row.as_json() for row in rows]}, indent=1) + "\n")
        console.print(f"Written to {plan.json}", soft_wrap=True)
    return 0 if all(row.latencies_ms for row in rows) else 1


def ratios(rows: Sequence[Row]) -> list[str]:
    """What media do to the slowest hundredth of the commands, one line for each kind that was measured both ways."""
    by_name = {(row.kind, row.load): row for row in rows}
    return [
        f"{kind}: p99 with media / without: {ratio(by_name[kind, LOADED].percentile(99), row.percentile(99))}"
        for (kind, load), row in by_name.items()
        if load == UNLOADED and (kind, LOADED) in by_name
    ]


def _measure(kind: str, plan: Plan, say: Any) -> list[Row]:
    rows = {load: Row(kind=kind, load=load) for load in (UNLOADED, *([LOADED] if plan.with_media else []))}
    with Robot(kind, media=plan.with_media) as robot, closing(Operator(robot.remote_port, BASE)) as operator:
        try:
            operator.wait_until_up()
        except PebbleError as error:
            raise PebbleError(f"{error}\n{robot.log()}") from None
        for number in range(plan.rounds):
            for load, row in rows.items():
                say(f"{kind}, round {number + 1} of {plan.rounds}, {'with' if load == LOADED else 'without'} media")
                if load == LOADED:
                    _drive_with_media(robot, operator, plan.seconds, row)
                else:
                    time.sleep(_SETTLE_S)
                    _drive(robot, operator, plan.seconds, row)
    return list(rows.values())


def _drive(robot: Robot, operator: Operator, seconds: float, row: Row) -> None:
    began, pids = time.monotonic_ns(), robot.pids()
    used = cpu_s(pids)
    sent = operator.drive(seconds, _RATE_HZ)
    row.cpu.append(100 * (cpu_s(pids) - used) / (time.monotonic_ns() - began) * 1e9)
    end = time.monotonic() + _ARRIVE_S
    while len(arrived := latencies_ms(sent, robot, began)) < len(sent) and time.monotonic() < end:
        time.sleep(_LOOK_S)
    row.latencies_ms += arrived
    row.sent += len(sent)


def latencies_ms(sent: dict[tuple[float, float], int], robot: Robot, since_ns: int) -> list[float]:
    """Of every command that has set the wheels."""
    return [
        (line.ns - sent[line.drive]) / 1e6
        for line in {line.drive: line for line in reversed(robot.lines(since_ns))}.values()
        if line.drive in sent
    ]


def _drive_with_media(robot: Robot, operator: Operator, seconds: float, row: Row) -> None:
    module, log = [sys.executable, "-m", "pebble.bench.control_load"], robot.run_dir.with_name("load.log")
    workers = [
        Worker("the reader of frames", [*module, "frames", str(robot.run_dir)], log),
        Worker("the watching operator", [*module, "media", str(robot.remote_port), BASE], log),
    ]
    try:
        operator.media(True)
        _wait_for_media(workers, robot)
        time.sleep(_SETTLE_S)
        before, began = _counts(workers), time.monotonic()
        _drive(robot, operator, seconds, row)
        after, took = _counts(workers), time.monotonic() - began
        row.flowed = {name: (after[name] - before.get(name, 0)) / took for name in after}
    finally:
        operator.media(False)
        end_workers(workers)


def _wait_for_media(workers: Sequence[Worker], robot: Robot) -> None:
    end = time.monotonic() + _MEDIA_START_S
    while missing := [name for name in _FLOWS if not _counts(workers).get(name)]:
        if time.monotonic() > end:
            raise PebbleError(f"no {', '.join(missing)} after {_MEDIA_START_S:.0f} s\n{robot.log()}")
        time.sleep(_LOOK_S)


def _counts(workers: Sequence[Worker]) -> dict[str, int]:
    for worker in workers:
        worker.tell("")
    return {name: count for worker in workers for name, count in worker.answer(_ANSWER_S).items()}


def _table(rows: Sequence[Row]) -> Table:
    table = Table(
        title="Drive commands at 20 Hz, from operator to pty, ms",
        title_justify="left",
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
    )
    for name in ("robot", "media"):
        table.add_column(name, no_wrap=True)
    for name in ("p50", "p99", "max", "n", "lost", "CPU %", *_FLOWS):
        table.add_column(name, justify="right", no_wrap=True)
    for row in rows:
        times = [f"{row.percentile(percent):.2f}" for percent in (50, 99, 100)]
        flowed = [f"{row.flowed[name]:.0f}/s" if name in row.flowed else "" for name in _FLOWS]
        counts = [str(len(row.latencies_ms)), str(row.sent - len(row.latencies_ms))]
        load = "flowing" if row.load == LOADED else "none"
        table.add_row(row.kind, load, *times, *counts, f"{percentile(row.cpu, 50):.1f}", *flowed)
    return table
