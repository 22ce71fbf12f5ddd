"""Shows where a command spends its time between the operator and the wheels, hop by hop.

Between the operator's publish call and the MCU's pty, the kernel records when the command's packets pass on loopback.
Zenoh's traffic inside the robot uses other sockets, so that part counts as one hop.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from itertools import pairwise

from rich.console import Console
from rich.progress import track

from pebble.bench.bridge_capture import PacketCapture, PassageTimes
from pebble.bench.bridge_drive import arrivals
from pebble.bench.bridge_driven_robot import DrivenRobot
from pebble.bench.bridge_operator import Wheels
from pebble.bench.bridge_plan import BridgePlan
from pebble.bench.engine import finish
from pebble.bench.results import Cell, Stopwatch, percentile
from pebble.bench.tables import figure, plain_table
from pebble.rig.robot import Robot
from pebble.runtime.signals import interrupted_by_signals
from pebble.transports.segments import sweep

#: By transport, in order: the component that holds the command. Results are compared by these names.
HOPS = {
    "mqtt": ("operator's client", "remote broker", "bridge", "robot's broker", "serial bridge"),
    "zenoh": ("operator's client", "remote broker", "bridge, fabric, serial bridge"),
}
ALL = "all the way"
_STARTUP_S = 1.0
_SLOWEST = 99  # per cent
_LEAST = 5  # commands among the slowest; fewer may be chance

Times = list[tuple[float, ...]]
"""For each command the time of each hop, ms."""


def run(plan: BridgePlan, console: Console | None = None) -> int:
    """Returns 0 if commands were traced all the way on every robot. Raises PebbleError."""
    console = console or Console()
    plan.check()
    watch = Stopwatch("bridge-profile", plan.command(), plan.options())
    found: dict[str, list[Times]] = {kind: [] for kind in plan.kinds}
    with interrupted_by_signals():
        try:
            for number in track(range(plan.rounds), "rounds", console=console, transient=True):
                for kind in plan.kinds[:: -1 if number % 2 else 1]:
                    found[kind].append(_trace_commands(kind, plan.seconds))
        finally:
            sweep()  # Zenoh leaves files behind even after a regular end
    cells = [cell for kind, rounds in found.items() for cell in cells_of(kind, rounds)]
    for kind, rounds in found.items():
        _show(kind, [times for one in rounds for times in one], console)
    lines = [
        line for kind, rounds in found.items() for line in assessment(kind, [hops for one in rounds for hops in one])
    ]
    finish(watch.results(cells, lines, quick=plan.quick), plan.output, console)
    return 0 if all(cell.samples for cell in cells) else 1


def _trace_commands(kind: str, seconds: float) -> Times:
    with DrivenRobot(kind) as driven_robot, PacketCapture(driven_robot.robot.broker_ports) as wire:
        driven_robot.wait()
        time.sleep(_STARTUP_S)
        wire.passed()
        segment = driven_robot.drive(seconds)
        driven_robot.match_arrivals([segment])  # waits for the last ones
        pty = arrivals(driven_robot.robot.lines(segment.began))
        return hops(segment.sent, [*_stations(wire.passed(), driven_robot.robot), pty])


def _stations(passed: PassageTimes, robot: Robot) -> list[Mapping[Wheels, int]]:
    """The times at which commands went into and out of each broker, in order."""
    return [_first(passed, port, side) for port in robot.broker_ports for side in (1, 0)]


def _first(passed: PassageTimes, port: int, side: int) -> dict[Wheels, int]:
    """When each command first passed with this port as its source (``side`` 0) or destination (1)."""
    found: dict[Wheels, int] = {}
    for way, commands in passed.items():
        if way[side] == port:
            found |= {wheels: min(ns, found.get(wheels, ns)) for wheels, ns in commands.items()}
    return found


def hops(sent: Mapping[Wheels, int], stations: Sequence[Mapping[Wheels, int]]) -> Times:
    """The hop times of every command that passed all stations."""
    ways = (
        [ns, *(station[speeds] for station in stations)]
        for speeds, ns in sent.items()
        if all(speeds in station for station in stations)
    )
    return [tuple((there - here) / 1e6 for here, there in pairwise(way)) for way in ways]


def typical(times: Times) -> Times:
    """The tenth of the commands that is closest to the median."""
    ordered = sorted(times, key=sum)
    return ordered[len(ordered) * 45 // 100 : max(1, len(ordered) * 55 // 100 + 1)]


def slowest(times: Times) -> Times:
    """The slowest hundredth of the commands, at least one."""
    limit = percentile([sum(one) for one in times], _SLOWEST)
    return [one for one in times if sum(one) >= limit]


def cells_of(kind: str, rounds: Sequence[Times]) -> list[Cell]:
    return [
        Cell(
            variant=kind,
            params={"hop": name},
            measure="hop",
            unit="ms",
            rounds=[[(*one, sum(one))[number] for one in times] for times in rounds],
        )
        for number, name in enumerate((*HOPS[kind], ALL))
    ]


def assessment(kind: str, times: Times) -> list[str]:
    """Names the hop in which the slowest commands lose their time, if there are enough of them."""
    if not times:
        return [f"{kind}: no command was traced all the way"]
    late = slowest(times)
    if len(late) < _LEAST:
        return [f"{kind}: {len(times)} commands are too few to tell where the slowest lose their time."]
    more = [slow - usual for slow, usual in zip(_means(late), _means(typical(times)), strict=True)]
    worst = max(range(len(HOPS[kind])), key=lambda number: more[number])
    share = 100 * more[worst] / sum(more) if sum(more) > 0 else 0.0
    return [
        f"{kind}: of what the slowest {len(late)} of {len(times)} commands take longer than a typical one"
        f" ({sum(more):.2f} ms), {share:.0f} % is spent in: {HOPS[kind][worst]}."
    ]


def _means(times: Times) -> list[float]:
    return [sum(hop) / len(times) for hop in zip(*times, strict=True)]


def _show(kind: str, times: Times, console: Console) -> None:
    table = plain_table(f"{kind}: {len(times)} commands, mean of each hop, ms", ["hop", "typical", "slowest 1 %"])
    if times:
        rows = [(*_means(few), sum(_means(few))) for few in (typical(times), slowest(times))]
        for number, name in enumerate((*HOPS[kind], ALL)):
            table.add_row(name, *(figure(row[number]) for row in rows))
    console.print(table)
