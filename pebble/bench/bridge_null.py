"""The null test of the bridge: one robot driven in three roles, one of which is a fifth slower.

All roles are the same robot in turns: fresh robots would take longer than the difference is worth. Its operator works
for a fifth of the usual time before every command; only in the slowed role has it looked at the clock before that.
"""

from __future__ import annotations

import time

from rich.console import Console
from rich.progress import track

from pebble.bench import null, output
from pebble.bench.bridge_drive import Stretch
from pebble.bench.bridge_driven import Driven
from pebble.bench.bridge_plan import Plan
from pebble.bench.bridge_tally import Tally
from pebble.bench.figures import percentile
from pebble.bench.results import Stopwatch
from pebble.bench.tables import latency_table
from pebble.errors import PebbleError
from pebble.signals import interrupted_by_signals
from pebble.transports.segments import sweep

RATE_HZ = 100.0  # more commands than an operator's 20 a second: the test is to be over soon
_TURN_S = 0.05
_SETTLE_S = 1.0
_PILOT_S = 2.0


def run(plan: Plan, console: Console | None = None) -> int:
    """0 if everything has figures; whether the comparison was fooled, the verdict says. Raises PebbleError."""
    console = console or Console()
    plan.check()
    [kind] = plan.kinds
    watch = Stopwatch("bridge-null", plan.command(), {**plan.options(), "rate_hz": RATE_HZ})
    tallies = [Tally(role, reports=False) for role in null.roles(kind)]
    with interrupted_by_signals():
        try:
            work_us = _measure(plan, tallies, console)
        finally:
            sweep()  # Zenoh leaves files behind even when it ends politely
    cells = [cell for tally in tallies for cell in tally.cells()]
    console.print(latency_table(f"{kind} against itself", cells, kind))
    lines = [*null.verdict(cells), _how(work_us, plan.rounds)]
    output.finish(watch.results(cells, lines, quick=plan.quick), plan.output, console)
    return 0 if all(cell.samples for cell in cells) else 1


def _measure(plan: Plan, tallies: list[Tally], console: Console) -> float:
    """For how long, in us, the operator worked at each command."""
    [kind] = plan.kinds
    with Driven(kind) as driven:
        with console.status(f"{kind}: starting a robot"):
            driven.wait()
            time.sleep(_SETTLE_S)
            work_us = null.SLOWDOWN * _usual_us(driven)
        for number in track(range(plan.rounds), "rounds", console=console, transient=True):
            _round(driven, tallies, plan.seconds, work_us, backwards=bool(number % 2))
    return work_us


def _usual_us(driven: Driven) -> float:
    stretch = driven.drive(_PILOT_S, RATE_HZ)
    [found] = driven.look_up([stretch])
    if not found.down:
        raise PebbleError(f"{driven.kind}: no command arrives\n{driven.robot.log()}")
    return 1000 * percentile(found.down, 50)


def _round(driven: Driven, tallies: list[Tally], seconds: float, work_us: float, *, backwards: bool) -> None:
    """Very short turns: nothing that lasts for a while hits one role alone."""
    turns = max(2, round(seconds / _TURN_S))
    driving: list[tuple[Tally, Stretch]] = []
    for turn in range(turns):
        for tally in tallies[::-1] if backwards != bool(turn % 2) else tallies:
            slowed = null.is_slowed(tally.variant)
            driving.append((tally, driven.drive(seconds / turns, RATE_HZ, work_us=work_us, slowed=slowed)))
    found = driven.look_up([stretch for _, stretch in driving])
    for tally in tallies:
        own = [(stretch, one) for (whose, stretch), one in zip(driving, found, strict=True) if whose is tally]
        tally.add_round([stretch for stretch, _ in own], [one for _, one in own])


def _how(work_us: float, rounds: int) -> str:
    return (
        f"Planted: {work_us:.0f} us, a fifth of the usual time. All {rounds} rounds are turns of one running robot, not"
        " fresh ones, and only commands to the wheels are judged."
    )
