"""A fleet of simulated MCU robots on one broker, driven by one operator: hearts, commands, and what all that costs.

Three processes of this machine: a stock mosquitto, the fleet (real firmware files, real TCP), and the operator. A
command's latency is from the operator's publish call to the change of the pins that it asks for.
"""

from __future__ import annotations

import itertools
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
from rich.console import Console
from rich.table import Table

from pebble.bench import output
from pebble.bench.figures import LONGEST_S, percentile, rounded
from pebble.bench.fleet_operator import STEPS
from pebble.bench.frames_process import Worker, end_workers
from pebble.bench.results import Cell, Stopwatch, Value
from pebble.bench.tables import plain_table
from pebble.bench.usage import cpu_s, pss_mb
from pebble.demo.broker import Broker, BrokerKind
from pebble.demo.programs import Program, end_all
from pebble.errors import PebbleError
from pebble.signals import interrupted_by_signals
from pebble.simulation.fleet import MOST, Moved, members
from pebble.simulation.wireless import KINDS

_ONLINE_S = 90.0
_ARRIVE_S = 1.0
_END_S = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """Every robot is driven at ``rate_hz`` for ``seconds``."""

    robots: int = 200
    seconds: float = 60.0
    rate_hz: float = 10.0
    kinds: Sequence[str] = KINDS
    output: Path = output.FOLDER
    quick: bool = False  # the results are marked so

    def check(self) -> None:
        """Raises PebbleError naming what makes no sense."""
        if not 1 <= self.robots <= MOST or not 0 < self.seconds <= LONGEST_S or not 0 < self.rate_hz <= 20:
            raise PebbleError(f"robots must be 1 to {MOST}, seconds at most {LONGEST_S:.0f}, rate at most 20 Hz")
        output.check_folder(self.output)

    def options(self) -> dict[str, Value | list[Value]]:
        """What figures depend on."""
        return {"robots": self.robots, "seconds": self.seconds, "rate_hz": self.rate_hz, "kinds": list(self.kinds)}

    def command(self) -> list[str]:
        """The command line that repeats it."""
        words = ["pebble", "bench", "fleet", "--robots", str(self.robots)]
        words += ["--seconds", f"{self.seconds:g}", "--rate", f"{self.rate_hz:g}"]
        return [*words, *(["--quick"] if self.quick else [])]


def plan(*, quick: bool = False, **given: Any) -> Plan:
    """The usual plan, or the one for the impatient, except for what is given."""
    usual = {"robots": 30, "seconds": 5.0} if quick else {}
    return Plan(quick=quick, **{**usual, **given})


@dataclass(slots=True, kw_only=True)
class Figures:
    """What one run showed; latencies in ms, rates in Hz, CPU in % of one core."""

    robots: int
    seconds: float
    online: int
    sent: int
    late: int  # commands that the operator could not send in time
    latencies_ms: list[float] = field(default_factory=list)
    beats_hz: list[float] = field(default_factory=list)
    longest_gap_s: float = 0.0  # without a beat of one robot
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

    def verdict(self) -> list[str]:
        """For people who think of a fleet."""
        half, most = (percentile(self.latencies_ms, percent) for percent in (50, 99))
        return [
            f"{self.online} of {self.robots} robots were online; of {self.sent} commands {self.lost} were overtaken or"
            " lost",
            f"wheels obeyed within {half:.1f} ms in half of all cases, within {most:.1f} ms in 99 of 100",
            f"no robot's heart paused for longer than {self.longest_gap_s:.2f} s",
        ]

    def _figures(self) -> dict[str, Value]:
        beats = {f"beats_{n}_hz": rounded(percentile(self.beats_hz, p), 3) for n, p in _SPREAD.items()}
        return {
            "sent": self.sent,
            "online": self.online,
            "late": self.late,
            **beats,
            "longest_gap_s": rounded(self.longest_gap_s, 3),
            **{f"cpu_{name}": rounded(share, 1) for name, share in self.cpu.items()},
            "fleet_mb": rounded(self.fleet_mb, 1),
            "mb_per_robot": rounded(self.fleet_mb / self.robots, 3),
        }


_SPREAD = {"min": 0, "median": 50, "max": 100}


def run(plan: Plan, console: Console | None = None) -> int:
    """Measure and show; 0 if every robot was online and could be driven. Raises PebbleError."""
    console = console or Console()
    plan.check()
    watch = Stopwatch("fleet", plan.command(), plan.options())
    with interrupted_by_signals(), console.status("starting") as status:
        figures = measure(plan, status.update)
    console.print(_table(figures))
    results = watch.results([figures.cell(plan.rate_hz)], figures.verdict(), quick=plan.quick)
    output.finish(results, plan.output, console)
    return 0 if figures.online == plan.robots and figures.latencies_ms else 1


def measure(plan: Plan, say: Any = lambda _text: None) -> Figures:
    """One run with processes of its own. Raises PebbleError if something does not start."""
    with tempfile.TemporaryDirectory(prefix="pbl-") as name:
        folder, programs, workers = Path(name), [], []
        try:
            broker = Broker("broker", BrokerKind.MOSQUITTO, folder)
            programs.append(broker.program)
            broker.wait(threading.Event())
            fleet = _start_fleet(plan, broker.port, folder)
            programs.insert(0, fleet)
            operator = _start_operator(plan, broker.port, folder)
            workers.append(operator)
            say(f"{plan.robots} robots are connecting")
            online = operator.answer(_ONLINE_S)["online"]
            say(f"{online} robots are online and driven for {plan.seconds:.0f} s")
            return _observe(plan, online, operator, fleet, broker, folder / "trace.jsonl")
        finally:
            end_workers(workers)
            end_all(programs, _END_S)


def _start_fleet(plan: Plan, port: int, folder: Path) -> Program:
    command = [sys.executable, "-m", "pebble.simulation.fleet_program", "--robots", str(plan.robots)]
    command += ["--kinds", ",".join(plan.kinds), "--broker", f"127.0.0.1:{port}"]
    return Program("the fleet", [*command, "--trace", str(folder / "trace.jsonl")], folder / "fleet.log")


def _start_operator(plan: Plan, port: int, folder: Path) -> Worker:
    ids = [identity.id for _, identity in members(plan.robots, plan.kinds)]
    command = [sys.executable, "-m", "pebble.bench.fleet_operator", str(port), str(plan.seconds), str(plan.rate_hz)]
    return Worker("the operator", [*command, *ids], folder / "operator.log")


def _observe(plan: Plan, online: int, operator: Worker, fleet: Program, broker: Broker, trace: Path) -> Figures:
    pids = {"broker": broker.program.pid, "fleet": fleet.pid, "operator": operator.pid}
    began, before = time.monotonic(), {name: cpu_s([pid]) for name, pid in pids.items()}
    said = operator.answer(plan.seconds + _ONLINE_S)
    used = {name: cpu_s([pid]) - before[name] for name, pid in pids.items()}
    took = time.monotonic() - began
    time.sleep(_ARRIVE_S)  # what is under way arrives, or is lost
    sent: list[list[int]] = said["sent"]
    ids = [identity.id for _, identity in members(plan.robots, plan.kinds)]
    return Figures(
        robots=plan.robots,
        seconds=plan.seconds,
        online=online,
        sent=sum(map(len, sent)),
        late=said["late"],
        latencies_ms=latencies_ms(dict(zip(ids, sent, strict=True)), _moves(trace)),
        beats_hz=[rate for beats in said["beats"] if (rate := _rate(beats)) is not None],
        longest_gap_s=longest_gap_s(said["beats"], said["began"], said["ended"]),
        cpu={name: 100 * seconds / took for name, seconds in used.items()},
        fleet_mb=pss_mb(fleet.pid),
    )


def latencies_ms(sent: dict[str, list[int]], moves: dict[str, list[Moved]]) -> list[float]:
    """Of every command that its robot's motors obeyed, while no other command asked for the same."""
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


def _moves(trace: Path) -> dict[str, list[Moved]]:
    moves: dict[str, list[Moved]] = {}
    raw = trace.read_bytes()
    for line in raw[: raw.rfind(b"\n") + 1].splitlines():
        moved = msgspec.json.decode(line, type=Moved)
        moves.setdefault(moved.robot, []).append(moved)
    return moves


def _rate(beats: list[int]) -> float | None:
    return (len(beats) - 1) / (beats[-1] - beats[0]) * 1e9 if len(beats) > 1 else None


def longest_gap_s(robots: list[list[int]], began: int, ended: int) -> float:
    """Of all robots, from the first command to the last: who falls silent is missed until the end."""
    gaps = (b - a for beats in robots for a, b in itertools.pairwise([began, *beats, ended]))
    return max(gaps, default=0) / 1e9


def _table(figures: Figures) -> Table:
    table = plain_table(f"{figures.robots} MCU robots on one broker, {figures.seconds:.0f} s", ("what", "figures"))
    beats = [f"{percentile(figures.beats_hz, percent):.2f}" for percent in _SPREAD.values()]
    times = [f"{percentile(figures.latencies_ms, percent):.1f}" for percent in (50, 95, 99, 100)]
    rows = {
        "robots online": f"{figures.online}",
        "heartbeats of a robot, Hz: min / median / max": " / ".join(beats),
        "longest time without one, s": f"{figures.longest_gap_s:.2f}",
        "command to pins, ms: p50 / p95 / p99 / max": " / ".join(times),
        "commands sent / obeyed / overtaken or lost": f"{figures.sent} / {len(figures.latencies_ms)} / {figures.lost}",
        "commands sent late": f"{figures.late}",
        **{f"CPU of the {name}, % of a core": f"{share:.1f}" for name, share in figures.cpu.items()},
        "CPU of a robot, % of a core": f"{figures.cpu.get('fleet', 0.0) / figures.robots:.3f}",
        "memory of the fleet / of a robot, MB": f"{figures.fleet_mb:.0f} / {figures.fleet_mb / figures.robots:.2f}",
    }
    for what, figure in rows.items():
        table.add_row(what, figure)
    return table
