"""Measures a fleet of simulated MCU robots on one broker: heartbeats, command latency and cost, with one operator.

Three processes on this machine: a stock mosquitto, the fleet (real firmware files, real TCP), and the operator. A
command's latency is from the operator's publish call to the resulting change of the pins.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec

from pebble.bench.comparison import Budget, Case, Comparison, Option, seconds
from pebble.bench.drivers import STEPS
from pebble.bench.pictures import ecdf
from pebble.bench.results import Cell, grouped, percentile, rounded
from pebble.bench.tables import COUNT, Grid, percentile_column, single_column
from pebble.bench.usage import cpu_s, pss_mb
from pebble.rig.processes import Processes
from pebble.simulation.fleet import MOST, Moved, members
from pebble.simulation.wireless import KINDS

_ONLINE_S = 90.0
_ARRIVE_S = 1.0
_SPREAD = {"min": 0, "median": 50, "max": 100}


def measure(case: Case) -> Iterator[Cell]:
    """One fleet, with processes of its own. Raises PebbleError if a process does not start."""
    run, count = case.run, case.run["robots"]
    ids = [identity.id for _, identity in members(count, KINDS)]
    with Processes() as processes:
        broker, trace = processes.broker(), processes.folder / "trace.jsonl"
        broker.wait()
        where = ("--kinds", ",".join(KINDS), "--broker", f"127.0.0.1:{broker.port}", "--trace", trace)
        fleet = processes.robot("fleet", "pebble.simulation.fleet_program", "--robots", count, *where)
        how = (broker.port, run["seconds"], run["rate"])
        operator = processes.worker("operator", "pebble.bench.drivers", *how, *ids)
        run.show(f"{count} robots are connecting")
        online = operator.answer(_ONLINE_S)["online"]
        run.show(f"{online} robots are online and being driven for {run['seconds']:.0f} s")
        pids = {"broker": broker.pid, "fleet": fleet.pid, "operator": operator.pid}
        began, before = time.monotonic(), {name: cpu_s([pid]) for name, pid in pids.items()}
        answer = operator.answer(run["seconds"] + _ONLINE_S)
        took = time.monotonic() - began
        cpu = {name: 100 * (cpu_s([pid]) - before[name]) / took for name, pid in pids.items()}
        time.sleep(_ARRIVE_S)  # commands in flight arrive, or count as lost
        yield cell_of(case, online, answer, read_moves(trace), cpu, pss_mb(fleet.pid))


def cell_of(
    case: Case, online: int, answer: dict[str, Any], moves: dict[str, list[Moved]], cpu: dict[str, float], mb: float
) -> Cell:
    """Latencies in ms, rates in Hz, CPU in % of one core; ``answer`` is the operator's."""
    robots, sent = case.run["robots"], answer["sent"]
    rates = [rate for heartbeats in answer["heartbeats"] if (rate := _rate(heartbeats)) is not None]
    ids = [identity.id for _, identity in members(robots, KINDS)]
    return case.cell(
        "command to pins", "ms", latencies_ms(dict(zip(ids, sent, strict=True)), moves),
        {"robots": robots, "rate": f"{case.run['rate']:g} Hz"},
        sent=sum(map(len, sent)),
        online=online,
        late=answer["late"],
        **{f"beats_{name}_hz": rounded(percentile(rates, percent), 3) for name, percent in _SPREAD.items()},
        longest_gap_s=rounded(longest_gap_s(answer["heartbeats"], answer["began"], answer["ended"]), 3),
        **{f"cpu_{name}": rounded(share, 1) for name, share in cpu.items()},
        fleet_mb=rounded(mb, 1),
        mb_per_robot=rounded(mb / robots, 3),
    )  # fmt: skip


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
    raw = trace.read_bytes()
    lines = raw[: raw.rfind(b"\n") + 1].splitlines()
    return grouped((msgspec.json.decode(line, type=Moved) for line in lines), lambda moved: moved.robot)


def _rate(heartbeats: list[int]) -> float | None:
    return (len(heartbeats) - 1) / (heartbeats[-1] - heartbeats[0]) * 1e9 if len(heartbeats) > 1 else None


def longest_gap_s(robots: list[list[int]], began: int, ended: int) -> float:
    """The longest gap of any robot between the first and the last command; a robot that stops counts until the end."""
    gaps = (b - a for heartbeats in robots for a, b in itertools.pairwise([began, *heartbeats, ended]))
    return max(gaps, default=0) / 1e9


# -- the report


def sentences(cells: Sequence[Cell]) -> Iterator[str]:
    """About connections, latency and heartbeats."""
    for cell in cells:
        yield (
            f"{cell.figures['online']} of {cell.params['robots']} robots were online; of {cell.figures['sent']}"
            f" commands {cell.lost} were overtaken or lost"
        )
        yield f"the wheels obeyed within {cell.percentile(50):.1f} ms (p50) and {cell.percentile(99):.1f} ms (p99)"
        yield f"the longest time without a heartbeat of one robot was {cell.figures['longest_gap_s']:.2f} s"


FLEET = Comparison(
    name="fleet",
    title="A fleet on one broker",
    what="Robots that are their own MCU, the real firmware on simulated pins, all on one stock broker and driven "
    "by one operator at 10 Hz each. The latency is from the operator's publish call to the change of the pins.",
    help="""Hundreds of MCU robots on one broker: heartbeats, command latency, cost.

    The real firmware files on simulated pins, real TCP; one operator drives all of them. Needs mosquitto.

    \b
        pebble bench fleet
        pebble bench fleet --robots 20 --seconds 10
    """,
    options=(
        Option(name="robots", kind=int, least=1, most=MOST, help="How many robots with Wi-Fi."),
        seconds("Driving time.", least=1),
        Option(name="rate", kind=float, least=0.1, most=20, help="Commands a second to each robot."),
    ),
    full=Budget(35, robots=200, seconds=60.0, rate=10.0),
    quick=Budget(12, robots=30, seconds=5.0),
    variants=("mqtt",),
    measure=measure,
    tables=(
        Grid(
            title="Command to pins, ms", rows=("robots", "rate"),
            columns=(*map(percentile_column, (50, 95, 99, 100)), COUNT, single_column("sent", "sent"),
                     single_column("late", "late")),
        ),
        Grid(
            title="Heartbeats of a robot, Hz; CPU, % of a core; memory, MB", rows=("robots",),
            columns=tuple(single_column(*words) for words in (
                ("least", "beats_min_hz"), ("median", "beats_median_hz"), ("most", "beats_max_hz"),
                ("longest gap, s", "longest_gap_s"), ("broker", "cpu_broker"), ("fleet", "cpu_fleet"),
                ("operator", "cpu_operator"), ("fleet, MB", "fleet_mb"), ("each", "mb_per_robot"),
            )),
        ),
    ),
    assessment=(sentences,),
    complete=lambda cells: all(cell.samples and cell.figures["online"] == cell.params["robots"] for cell in cells),
    pictures=(ecdf("Fleet"),),
    reported_full=("--robots", "100", "--seconds", "20"),
)  # fmt: skip
