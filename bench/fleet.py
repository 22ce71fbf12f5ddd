"""Measures a fleet of simulated MCU robots on one broker: heartbeats, command latency and cost, with one operator.

Three processes on this machine: a stock mosquitto, the fleet (real firmware files, real TCP), and the operator:
``python -m pebble.bench.fleet PORT SECONDS ID…``. It writes a JSON line when every robot is online, and the results
when it has driven for ``SECONDS``.
"""

from __future__ import annotations

import itertools
import json
import os
import sys
import time
from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import msgspec
from paho.mqtt.client import MQTTMessage

from pebble.bench.clients import MANY, StockClient, axes_of
from pebble.bench.comparison import Budget, Case, Comparison, Measuring, Option, Report, seconds
from pebble.bench.pictures import ecdf
from pebble.bench.results import Cell, grouped, rounded
from pebble.bench.tables import COUNT, LOST, Grid, percentile_column, single_column
from pebble.bench.usage import cpu_s, pss_mb
from pebble.contract import DRIVE, ONLINE
from pebble.contract.identity import Identity
from pebble.rig.processes import Processes
from pebble.rig.worker_end import answer, serve_on_thread
from pebble.simulation.fleet import MOST, Moved, members
from pebble.simulation.trace import complete_lines
from pebble.simulation.wireless import KINDS

#: Wheel speeds, left and right, in sequence: no robot gets the same command twice within eight commands.
STEPS: Final = ((1, 1), (-1, -1), (1, 0), (-1, 0), (1, -1), (0, 1), (-1, 1), (0, -1))
RATE_HZ: Final = 10.0  # of each robot
_UP_S, _ARRIVE_S, _POLL_S = 90.0, 1.0, 0.05


def measure(case: Case) -> Iterator[Cell]:
    """One fleet, with processes of its own. Raises PebbleError if a process does not start, or not all are online."""
    run, count = case.run, case.run["robots"]
    ids = [identity.id for _, identity in members(count, KINDS)]
    with Processes() as processes:
        broker, trace = processes.broker(), processes.folder / "trace.jsonl"
        broker.wait()
        where = ("--kinds", ",".join(KINDS), "--broker", f"127.0.0.1:{broker.port}", "--trace", trace)
        fleet = processes.robot("fleet", "pebble.simulation.fleet_program", "--robots", count, *where)
        operator = processes.worker("operator", "pebble.bench.fleet", broker.port, run["seconds"], *ids)
        run.show(f"{count} robots are connecting")
        operator.answer(_UP_S)
        run.show(f"{count} robots are online and driven")
        pids = {"broker": broker.pid, "fleet": fleet.pid, "operator": operator.pid}
        began, before = time.monotonic(), {name: cpu_s([pid]) for name, pid in pids.items()}
        found = operator.answer(run["seconds"] + _UP_S)
        took = time.monotonic() - began
        cpu = {name: 100 * (cpu_s([pid]) - before[name]) / took for name, pid in pids.items()}
        time.sleep(_ARRIVE_S)  # commands in flight arrive, or count as lost
        yield cell_of(case, found, read_moves(trace), {**cpu, "mb": pss_mb(fleet.pid)})


def cell_of(case: Case, found: dict[str, Any], moves: dict[str, list[Moved]], cost: dict[str, float]) -> Cell:
    """``found`` is the operator's answer; ``cost`` has the CPU by process, % of a core, and the fleet's memory, MB."""
    robots, sent = case.run["robots"], found["sent"]
    began, ended = min(map(min, sent.values())), max(map(max, sent.values()))
    heartbeats = [[ns for ns in own if began <= ns <= ended] for own in found["heartbeats"]]
    return case.cell(
        "command to pins", "ms", latencies_ms(sent, moves), {"robots": robots, "rate": f"{RATE_HZ:g} Hz"},
        sent=sum(map(len, sent.values())),
        late=found["late"],
        longest_gap_s=rounded(longest_gap_s(heartbeats, began, ended), 3),
        mb_per_robot=rounded(cost.pop("mb") / robots, 3),
        **{f"cpu_{name}": rounded(share, 1) for name, share in cost.items()},
    )  # fmt: skip


def latencies_ms(sent: Mapping[str, Sequence[int]], moves: Mapping[str, Sequence[Moved]]) -> list[float]:
    """Latencies of all commands that the motors obeyed before another command asked for the same speeds."""
    found = []
    for robot, times in sent.items():
        changes = grouped(moves.get(robot, ()), lambda moved: tuple(round(motor, 1) for motor in moved.motors))
        for number, time_ns in enumerate(times):
            own, again = changes.get(STEPS[number % len(STEPS)], []), number + len(STEPS)
            at = bisect_left(own, time_ns, key=lambda moved: moved.ns)
            if at < len(own) and (again >= len(times) or own[at].ns < times[again]):
                found.append((own[at].ns - time_ns) / 1e6)
    return found


def read_moves(trace: Path) -> dict[str, list[Moved]]:
    moves = (msgspec.json.decode(line, type=Moved) for line in complete_lines(trace)[0])
    return grouped(moves, lambda moved: moved.robot)


def longest_gap_s(robots: Sequence[Sequence[int]], began: int, ended: int) -> float:
    """The longest gap of any robot between the first and the last command; a robot that stops counts until the end."""
    return max(b - a for own in robots for a, b in itertools.pairwise([began, *own, ended])) / 1e9


def drive_fleet(port: int, seconds: float, ids: Sequence[str]) -> None:
    """Drives a whole fleet in :data:`STEPS`, evenly spread, and subscribes to all heartbeats.

    It answers when each robot's commands were published (CLOCK_MONOTONIC, ns) and its heartbeats arrived, and how many
    commands were more than a period late.
    """
    bases = [Identity("pebble", "robots", name).base for name in ids]
    heartbeats: dict[str, list[int]] = {ONLINE.topic(base): [] for base in bases}
    sent: dict[str, list[int]] = {name: [] for name in ids}
    topics = [DRIVE.topic(base) for base in bases]
    bodies = [json.dumps(axes_of(left, right)) for left, right in STEPS]

    def receive(message: MQTTMessage) -> None:
        if not message.retain and b"true" in message.payload:
            heartbeats[message.topic].append(time.monotonic_ns())

    client = StockClient(receive, [(topic, 0) for topic in heartbeats])
    client.paho.max_inflight_messages_set(MANY)
    client.open(port)
    while not all(heartbeats.values()):
        time.sleep(_POLL_S)
    answer({})
    began, late, gap = time.monotonic(), 0, 1 / RATE_HZ / len(ids)
    for number in range(round(seconds * RATE_HZ) * len(ids)):
        step, robot = divmod(number, len(ids))
        left = began + number * gap - time.monotonic()
        time.sleep(max(0.0, left))
        late += left < -1 / RATE_HZ
        sent[ids[robot]].append(time.monotonic_ns())
        client.paho.publish(topics[robot], bodies[step % len(STEPS)], qos=DRIVE.default_qos)
    answer({"late": late, "sent": sent, "heartbeats": list(heartbeats.values())})
    client.close()


_COLUMNS = {
    "sent": "sent", "late": "late", "gap, s": "longest_gap_s",
    "broker": "cpu_broker", "fleet": "cpu_fleet", "operator": "cpu_operator", "MB": "mb_per_robot",
}  # fmt: skip
FLEET = Comparison(
    name="fleet",
    title="A fleet on one broker",
    what="Robots that are their own MCU, the real firmware on simulated pins, all on one stock broker and driven "
    "by one operator at 10 Hz each. The latency is from the operator's publish call to the change of the pins.",
    help="Hundreds of MCU robots on one broker, driven by one operator: heartbeats, command latency, cost. The real "
    "firmware on simulated pins, real TCP. Needs mosquitto.",
    options=(
        Option(name="robots", kind=int, least=1, most=MOST, help="How many robots with Wi-Fi."),
        seconds("Driving time.", least=1),
    ),
    full=Budget(35, robots=200, seconds=60.0),
    quick=Budget(12, robots=30, seconds=5.0),
    variants=("mqtt",),
    measuring=Measuring(measure=measure),
    report=Report(
        tables=(
            Grid(
                title="Command to pins, ms; longest gap between heartbeats; CPU, % of a core; memory of each robot",
                rows=("robots", "rate"),
                columns=(
                    *map(percentile_column, (50, 95, 99, 100)), COUNT, LOST,
                    *(single_column(head, name) for head, name in _COLUMNS.items()),
                ),
            ),
        ),
        pictures=(ecdf("Fleet"),),
        reported_full=("--robots", "100", "--seconds", "20"),
    ),
)  # fmt: skip

if __name__ == "__main__":
    serve_on_thread(lambda _line: None, lambda: os._exit(0))
    drive_fleet(int(sys.argv[1]), float(sys.argv[2]), sys.argv[3:])
