"""Measures a fleet of simulated MCU robots on one broker: heartbeats, command latency and cost, with one operator.

Three processes on this machine: a stock mosquitto, the fleet (real firmware files, real TCP), and the operator. A
command's latency is from the operator's publish call to the resulting change of the pins.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
from rich.console import Console
from rich.table import Table

from pebble.bench import output
from pebble.bench.fleet_operator import STEPS
from pebble.bench.percentiles import LONGEST_S, percentile, rounded
from pebble.bench.results import Cell, Stopwatch, Value
from pebble.bench.tables import plain_table
from pebble.bench.usage import cpu_s, pss_mb
from pebble.errors import PebbleError
from pebble.rig.processes import Processes
from pebble.rig.programs import Program
from pebble.rig.worker import Worker
from pebble.runtime.signals import interrupted_by_signals
from pebble.simulation.fleet import MOST, Moved, members
from pebble.simulation.wireless import KINDS

_ONLINE_S = 90.0
_ARRIVE_S = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetPlan:
    """Every robot is driven at ``rate_hz`` for ``seconds``."""

    robots: int = 200
    seconds: float = 60.0
    rate_hz: float = 10.0
    kinds: Sequence[str] = KINDS
    output: Path = output.FOLDER
    quick: bool = False  # the results are marked as quick

    def check(self) -> None:
        """Raises PebbleError naming an invalid option."""
        if not 1 <= self.robots <= MOST or not 0 < self.seconds <= LONGEST_S or not 0 < self.rate_hz <= 20:
            raise PebbleError(f"robots must be 1 to {MOST}, seconds at most {LONGEST_S:.0f}, rate at most 20 Hz")
        output.check_folder(self.output)

    def options(self) -> dict[str, Value | list[Value]]:
        """All options that affect the results."""
        return {"robots": self.robots, "seconds": self.seconds, "rate_hz": self.rate_hz, "kinds": list(self.kinds)}

    def command(self) -> list[str]:
        """The command line that repeats the run."""
        words = ["pebble", "bench", "fleet", "--robots", str(self.robots)]
        words += ["--seconds", f"{self.seconds:g}", "--rate", f"{self.rate_hz:g}"]
        return [*words, *(["--quick"] if self.quick else [])]


def plan(*, quick: bool = False, **given: Any) -> FleetPlan:
    """The default or quick plan, with the ``given`` options replaced."""
    usual = {"robots": 30, "seconds": 5.0} if quick else {}
    return FleetPlan(quick=quick, **{**usual, **given})


@dataclass(slots=True, kw_only=True)
class FleetMetrics:
    """Results of one run; latencies in ms, rates in Hz, CPU in % of one core."""

    robots: int
    seconds: float
    online: int
    sent: int
    late: int  # commands that the operator could not send in time
    latencies_ms: list[float] = field(default_factory=list)
    heartbeats_hz: list[float] = field(default_factory=list)
    longest_gap_s: float = 0.0  # between two heartbeats of one robot
    cpu: dict[str, float] = field(default_factory=dict)
    fleet_mb: float = 0.0

    @property
    def lost(self) -> int:
        return self.sent - len(self.latencies_ms)

    def cell(self, rate_hz: float) -> Cell:
        """A single round: one fleet, started once."""
        return Cell(
            variant="mqtt",
            params={"robots": self.robots, "rate": f"{rate_hz:g} Hz"},
            measure="command to pins",
            unit="ms",
            rounds=[self.latencies_ms],
            figures=self._figures(),
        )

    def assessment(self) -> list[str]:
        """Sentences about connections, latency and heartbeats."""
        half, most = (percentile(self.latencies_ms, percent) for percent in (50, 99))
        return [
            f"{self.online} of {self.robots} robots were online; of {self.sent} commands {self.lost} were overtaken or"
            " lost",
            f"the wheels obeyed within {half:.1f} ms (p50) and {most:.1f} ms (p99)",
            f"the longest time without a heartbeat of one robot was {self.longest_gap_s:.2f} s",
        ]

    def _figures(self) -> dict[str, Value]:
        heartbeats = {f"beats_{n}_hz": rounded(percentile(self.heartbeats_hz, p), 3) for n, p in _SPREAD.items()}
        return {
            "sent": self.sent,
            "online": self.online,
            "late": self.late,
            **heartbeats,
            "longest_gap_s": rounded(self.longest_gap_s, 3),
            **{f"cpu_{name}": rounded(share, 1) for name, share in self.cpu.items()},
            "fleet_mb": rounded(self.fleet_mb, 1),
            "mb_per_robot": rounded(self.fleet_mb / self.robots, 3),
        }


_SPREAD = {"min": 0, "median": 50, "max": 100}


def run(plan: FleetPlan, console: Console | None = None) -> int:
    """Measures, prints and writes; returns 0 if every robot was online and could be driven. Raises PebbleError."""
    console = console or Console()
    plan.check()
    watch = Stopwatch("fleet", plan.command(), plan.options())
    with interrupted_by_signals(), console.status("starting") as status:
        metrics = measure(plan, status.update)
    console.print(_table(metrics))
    results = watch.results([metrics.cell(plan.rate_hz)], metrics.assessment(), quick=plan.quick)
    output.finish(results, plan.output, console)
    return 0 if metrics.online == plan.robots and metrics.latencies_ms else 1


def measure(plan: FleetPlan, show_step: Any = lambda _text: None) -> FleetMetrics:
    """Measures one run with processes of its own. Raises PebbleError if a process does not start."""
    ids = [identity.id for _, identity in members(plan.robots, plan.kinds)]
    with Processes() as processes:
        broker, trace = processes.broker(), processes.folder / "trace.jsonl"
        broker.wait()
        where = ["--kinds", ",".join(plan.kinds), "--broker", f"127.0.0.1:{broker.port}", "--trace", trace]
        fleet = processes.robot("fleet", "pebble.simulation.fleet_program", "--robots", plan.robots, *where)
        how = (broker.port, plan.seconds, plan.rate_hz)
        operator = processes.worker("operator", "pebble.bench.fleet_operator", *how, *ids)
        show_step(f"{plan.robots} robots are connecting")
        online = operator.answer(_ONLINE_S)["online"]
        show_step(f"{online} robots are online and being driven for {plan.seconds:.0f} s")
        return _observe(plan, online, {"broker": broker, "fleet": fleet, "operator": operator}, operator, trace)


def _observe(
    plan: FleetPlan, online: int, programs: Mapping[str, Program], operator: Worker, trace: Path
) -> FleetMetrics:
    pids = {name: program.pid for name, program in programs.items()}
    began, before = time.monotonic(), {name: cpu_s([pid]) for name, pid in pids.items()}
    answer = operator.answer(plan.seconds + _ONLINE_S)
    used = {name: cpu_s([pid]) - before[name] for name, pid in pids.items()}
    took = time.monotonic() - began
    time.sleep(_ARRIVE_S)  # commands in flight arrive, or count as lost
    sent: list[list[int]] = answer["sent"]
    ids = [identity.id for _, identity in members(plan.robots, plan.kinds)]
    return FleetMetrics(
        robots=plan.robots,
        seconds=plan.seconds,
        online=online,
        sent=sum(map(len, sent)),
        late=answer["late"],
        latencies_ms=latencies_ms(dict(zip(ids, sent, strict=True)), read_moves(trace)),
        heartbeats_hz=[rate for heartbeats in answer["heartbeats"] if (rate := _rate(heartbeats)) is not None],
        longest_gap_s=longest_gap_s(answer["heartbeats"], answer["began"], answer["ended"]),
        cpu={name: 100 * seconds / took for name, seconds in used.items()},
        fleet_mb=pss_mb(pids["fleet"]),
    )


def latencies_ms(sent: dict[str, list[int]], moves: dict[str, list[Moved]]) -> list[float]:
    """Latencies of all commands that the motors obeyed before another command asked for the same speeds."""
    found = []
    for robot, times in sent.items():
        changes, at = moves.get(robot, []), 0
        for number, time_ns in enumerate(times):
            again = times[number + len(STEPS)] if number + len(STEPS) < len(times) else 1 << 63
            while at < len(changes) and changes[at].ns < time_ns:
                at += 1
            change = next((c for c in changes[at : at + len(STEPS)] if _is(c, STEPS[number % len(STEPS)])), None)
            if change is not None and change.ns < again:
                found.append((change.ns - time_ns) / 1e6)
    return found


def _is(moved: Moved, step: tuple[int, int]) -> bool:
    return all(abs(motor - wish) < 0.01 for motor, wish in zip(moved.motors, step, strict=True))


def read_moves(trace: Path) -> dict[str, list[Moved]]:
    moves: dict[str, list[Moved]] = {}
    raw = trace.read_bytes()
    for line in raw[: raw.rfind(b"\n") + 1].splitlines():
        moved = msgspec.json.decode(line, type=Moved)
        moves.setdefault(moved.robot, []).append(moved)
    return moves


def _rate(heartbeats: list[int]) -> float | None:
    return (len(heartbeats) - 1) / (heartbeats[-1] - heartbeats[0]) * 1e9 if len(heartbeats) > 1 else None


def longest_gap_s(robots: list[list[int]], began: int, ended: int) -> float:
    """The longest gap of any robot between the first and the last command; a robot that stops counts until the end."""
    gaps = (b - a for heartbeats in robots for a, b in itertools.pairwise([began, *heartbeats, ended]))
    return max(gaps, default=0) / 1e9


def _table(metrics: FleetMetrics) -> Table:
    table = plain_table(f"{metrics.robots} MCU robots on one broker, {metrics.seconds:.0f} s", ("what", "value"))
    heartbeats = [f"{percentile(metrics.heartbeats_hz, percent):.2f}" for percent in _SPREAD.values()]
    times = [f"{percentile(metrics.latencies_ms, percent):.1f}" for percent in (50, 95, 99, 100)]
    rows = {
        "robots online": f"{metrics.online}",
        "heartbeats of a robot, Hz: min / median / max": " / ".join(heartbeats),
        "longest time without one, s": f"{metrics.longest_gap_s:.2f}",
        "command to pins, ms: p50 / p95 / p99 / max": " / ".join(times),
        "commands sent / obeyed / overtaken or lost": f"{metrics.sent} / {len(metrics.latencies_ms)} / {metrics.lost}",
        "commands sent late": f"{metrics.late}",
        **{f"CPU of the {name}, % of a core": f"{share:.1f}" for name, share in metrics.cpu.items()},
        "CPU of a robot, % of a core": f"{metrics.cpu.get('fleet', 0.0) / metrics.robots:.3f}",
        "memory of the fleet / of a robot, MB": f"{metrics.fleet_mb:.0f} / {metrics.fleet_mb / metrics.robots:.2f}",
    }
    for what, figure in rows.items():
        table.add_row(what, figure)
    return table
