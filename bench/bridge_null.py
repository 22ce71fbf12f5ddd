"""The null test of the bridge: one robot driven in three roles, one of which is slowed by a fifth.

All roles use the same robot in turns: fresh robots would differ by more than the planted difference. The operator works
for a fifth of the usual latency before every command; only in the slowed role it reads the clock before that work.
"""

from __future__ import annotations

import time

from rich.console import Console
from rich.progress import track

from pebble.bench import null
from pebble.bench.bridge_drive import DriveSegment
from pebble.bench.bridge_driven_robot import DrivenRobot
from pebble.bench.bridge_plan import BridgePlan
from pebble.bench.bridge_tally import Tally
from pebble.bench.engine import finish
from pebble.bench.results import Stopwatch, percentile
from pebble.bench.tables import latency_table
from pebble.errors import PebbleError
from pebble.runtime.signals import interrupted_by_signals
from pebble.transports.segments import sweep

RATE_HZ = 100.0  # more than an operator's 20 a second, to shorten the test
_TURN_S = 0.05
_STARTUP_S = 1.0
_PILOT_S = 2.0


def run(plan: BridgePlan, console: Console | None = None) -> int:
    """Returns 0 if everything has results; the assessment says whether the comparison is sound. Raises PebbleError."""
    console = console or Console()
    plan.check()
    [kind] = plan.kinds
    watch = Stopwatch("bridge-null", plan.command(), {**plan.options(), "rate_hz": RATE_HZ})
    tallies = [Tally(role, reports=False) for role in null.roles(kind)]
    with interrupted_by_signals():
        try:
            work_us = _measure(plan, tallies, console)
        finally:
            sweep()  # Zenoh leaves files behind even after a regular end
    cells = [cell for tally in tallies for cell in tally.cells()]
    console.print(latency_table(f"{kind} against itself", cells, kind))
    lines = [*null.assessment(cells), _method_note(work_us, plan.rounds)]
    finish(watch.results(cells, lines, quick=plan.quick), plan.output, console)
    return 0 if all(cell.samples for cell in cells) else 1


def _measure(plan: BridgePlan, tallies: list[Tally], console: Console) -> float:
    """Measures all rounds; returns how long, in us, the operator worked at each command."""
    [kind] = plan.kinds
    with DrivenRobot(kind) as driven_robot:
        with console.status(f"{kind}: starting a robot"):
            driven_robot.wait()
            time.sleep(_STARTUP_S)
            work_us = null.SLOWDOWN * _usual_us(driven_robot)
        for number in track(range(plan.rounds), "rounds", console=console, transient=True):
            _round(driven_robot, tallies, plan.seconds, work_us, backwards=bool(number % 2))
    return work_us


def _usual_us(driven_robot: DrivenRobot) -> float:
    segment = driven_robot.drive(_PILOT_S, RATE_HZ)
    [found] = driven_robot.match_arrivals([segment])
    if not found.down:
        raise PebbleError(f"{driven_robot.kind}: no command arrived\n{driven_robot.robot.log()}")
    return 1000 * percentile(found.down, 50)


def _round(driven_robot: DrivenRobot, tallies: list[Tally], seconds: float, work_us: float, *, backwards: bool) -> None:
    """Uses very short turns, so that a disturbance of the machine hits all roles."""
    turns = max(2, round(seconds / _TURN_S))
    driving: list[tuple[Tally, DriveSegment]] = []
    for turn in range(turns):
        for tally in tallies[::-1] if backwards != bool(turn % 2) else tallies:
            slowed = null.is_slowed(tally.variant)
            driving.append((tally, driven_robot.drive(seconds / turns, RATE_HZ, work_us=work_us, slowed=slowed)))
    found = driven_robot.match_arrivals([segment for _, segment in driving])
    for tally in tallies:
        own = [(segment, one) for (whose, segment), one in zip(driving, found, strict=True) if whose is tally]
        tally.add_round([segment for segment, _ in own], [one for _, one in own])


def _method_note(work_us: float, rounds: int) -> str:
    return (
        f"Planted: {work_us:.0f} us, a fifth of the usual latency. All {rounds} rounds are turns of one running robot,"
        " not fresh robots, and only commands to the wheels are assessed."
    )
