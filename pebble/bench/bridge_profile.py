"""Where on its way from the operator to the wheels a command spends its time: hop by hop.

Between the operator's publish call and the MCU's pty the kernel tells when the command's packets pass on loopback. What
Zenoh carries inside the robot goes over other sockets, so that part is one hop.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from itertools import pairwise

from rich.console import Console
from rich.progress import track

from pebble.bench import output
from pebble.bench.bridge_drive import arrivals
from pebble.bench.bridge_driven import Driven
from pebble.bench.bridge_operator import Wheels
from pebble.bench.bridge_plan import Plan
from pebble.bench.bridge_robot import Robot
from pebble.bench.bridge_wire import Passed, Wire
from pebble.bench.figures import percentile
from pebble.bench.results import Cell, Stopwatch
from pebble.bench.tables import figure, plain_table
from pebble.signals import interrupted_by_signals
from pebble.transports.segments import sweep

#: By transport, in order: who has the command in hand.
HOPS = {
    "mqtt": ("operator's client", "remote broker", "bridge", "robot's broker", "serial bridge"),
    "zenoh": ("operator's client", "remote broker", "bridge, fabric, serial bridge"),
}
ALL = "all the way"
_SETTLE_S = 1.0
_SLOWEST = 99  # per cent
_LEAST = 5  # of the slowest: fewer may be chance

Times = list[tuple[float, ...]]
"""Of each command: the ms of each hop."""


def run(plan: Plan, console: Console | None = None) -> int:
    """0 if commands were followed all the way on every robot. Raises PebbleError."""
    console = console or Console()
    plan.check()
    watch = Stopwatch("bridge-profile", plan.command(), plan.options())
    found: dict[str, list[Times]] = {kind: [] for kind in plan.kinds}
    with interrupted_by_signals():
        try:
            for number in track(range(plan.rounds), "rounds", console=console, transient=True):
                for kind in plan.kinds[:: -1 if number % 2 else 1]:
                    found[kind].append(_follow(kind, plan.seconds))
        finally:
            sweep()  # Zenoh leaves files behind even when it ends politely
    cells = [cell for kind, rounds in found.items() for cell in cells_of(kind, rounds)]
    for kind, rounds in found.items():
        _show(kind, [times for one in rounds for times in one], console)
    lines = [line for kind, rounds in found.items() for line in verdict(kind, [hops for one in rounds for hops in one])]
    output.finish(watch.results(cells, lines, quick=plan.quick), plan.output, console)
    return 0 if all(cell.samples for cell in cells) else 1


def _follow(kind: str, seconds: float) -> Times:
    with Driven(kind) as driven, Wire(driven.robot.broker_ports) as wire:
        driven.wait()
        time.sleep(_SETTLE_S)
        wire.passed()
        stretch = driven.drive(seconds)
        driven.look_up([stretch])  # waits for the last ones
        pty = arrivals(driven.robot.lines(stretch.began))
        return hops(stretch.sent, [*_stations(wire.passed(), driven.robot), pty])


def _stations(passed: Passed, robot: Robot) -> list[Mapping[Wheels, int]]:
    """Into and out of each broker, in order."""
    return [_first(passed, port, side) for port in robot.broker_ports for side in (1, 0)]


def _first(passed: Passed, port: int, side: int) -> dict[Wheels, int]:
    """When each command first had this port as its source (``side`` 0) or its destination (1)."""
    found: dict[Wheels, int] = {}
    for way, commands in passed.items():
        if way[side] == port:
            found |= {wheels: min(ns, found.get(wheels, ns)) for wheels, ns in commands.items()}
    return found


def hops(sent: Mapping[Wheels, int], stations: Sequence[Mapping[Wheels, int]]) -> Times:
    """Of every command that came by all stations."""
    ways = (
        [ns, *(station[speeds] for station in stations)]
        for speeds, ns in sent.items()
        if all(speeds in station for station in stations)
    )
    return [tuple((there - here) / 1e6 for here, there in pairwise(way)) for way in ways]


def typical(times: Times) -> Times:
    """The tenth of the commands around the median."""
    ordered = sorted(times, key=sum)
    return ordered[len(ordered) * 45 // 100 : max(1, len(ordered) * 55 // 100 + 1)]


def slowest(times: Times) -> Times:
    """The slowest hundredth of the commands, one at least."""
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


def verdict(kind: str, times: Times) -> list[str]:
    """Which hop makes the slowest slow; nothing is claimed of a handful."""
    if not times:
        return [f"{kind}: no command was followed all the way"]
    late = slowest(times)
    if len(late) < _LEAST:
        return [f"{kind}: {len(times)} commands are too few to say what makes the slowest slow."]
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
