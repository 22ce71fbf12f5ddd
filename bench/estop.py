"""Measures the emergency stop: until the wheels are at rest, until every motor owner has confirmed it, and a hold.

Two Linux robots, one on each local transport, and a fleet of boards with Wi-Fi share one remote broker. Each is driven
all the time by a process of its own; stops and resets come from this one. Real processes, stock mosquitto, loopback.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from pebble.bench import estop_report, output
from pebble.bench.estop_driver import RATE_HZ
from pebble.bench.estop_report import Sample, Samples
from pebble.bench.estop_robots import Robots
from pebble.bench.results import Stopwatch, Value
from pebble.bench.rounds import Rounds
from pebble.errors import PebbleError
from pebble.rig.robot import KINDS
from pebble.runtime.signals import interrupted_by_signals
from pebble.simulation.fleet import MOST
from pebble.transports.segments import sweep

ROUNDS, QUICK_ROUNDS = 10, 2
STOPS, QUICK_STOPS = 12, 3  # of each Linux robot in a round
ALL_STOPS, QUICK_ALL_STOPS = 3, 2  # of all robots in a round


@dataclass(frozen=True, slots=True, kw_only=True)
class EstopPlan:
    """The options of a run. In each round all processes are new."""

    rounds: int | None = None  # None: the default
    boards: int = 50
    quick: bool = False
    output: Path = output.FOLDER

    @property
    def count(self) -> int:
        return self.rounds or (QUICK_ROUNDS if self.quick else ROUNDS)

    @property
    def stops(self) -> int:
        return QUICK_STOPS if self.quick else STOPS

    @property
    def all_stops(self) -> int:
        return QUICK_ALL_STOPS if self.quick else ALL_STOPS

    def check(self) -> None:
        """Raises PebbleError naming an invalid option."""
        if not 0 <= self.boards <= MOST:
            raise PebbleError(f"boards must be 0 to {MOST}")
        output.check_folder(self.output)

    def options(self) -> dict[str, Value | list[Value]]:
        """All options that affect the results."""
        counts: dict[str, Value | list[Value]] = {"stops": self.stops, "all_stops": self.all_stops}
        return {"rounds": self.count, "boards": self.boards, "rate_hz": RATE_HZ, **counts}

    def command(self) -> list[str]:
        """The command line that repeats the run."""
        words = ["pebble", "bench", "estop", "--rounds", str(self.count), "--boards", str(self.boards)]
        return [*words, *(["--quick"] if self.quick else [])]


def run(plan: EstopPlan, console: Console | None = None) -> int:
    """Measures, prints and writes; returns 0 if everything has results of enough rounds. Raises PebbleError."""
    console = console or Console()
    plan.check()
    load = os.getloadavg()[0]
    watch = Stopwatch("estop", plan.command(), plan.options())
    rounds = Rounds(plan.count, console)
    done: list[list[Sample]] = []
    with interrupted_by_signals(), Progress(console=console, transient=True) as progress:
        task = progress.add_task("", total=plan.count)
        try:
            for number in range(plan.count):

                def show_step(what: str, number: int = number) -> None:
                    text = f"round {number + 1} of {plan.count}: {what}"
                    progress.update(task, completed=number, description=text)

                with rounds.attempt(number):
                    done.append(_round(plan, show_step).all)
        finally:
            sweep()  # Zenoh leaves files behind even after a regular end
    cells = estop_report.cells_of(done)
    estop_report.show(cells, console)
    lines = [*rounds.notes(), *estop_report.assessment(cells), f"Load of the machine before the run: {load:.2f}"]
    output.finish(watch.results(cells, lines, quick=plan.quick), plan.output, console)
    return rounds.code(cells)


def _round(plan: EstopPlan, show_step: Callable[[str], None]) -> Samples:
    """Measures one round. Raises PebbleError."""
    samples = Samples()
    with Robots(plan.boards) as robots:
        show_step("Linux robots start while a stop is held")
        robots.hold_linux(samples)
        for number in range(plan.stops):
            show_step(f"stop {number + 1} of {plan.stops} of one robot")
            for kind in KINDS[:: -1 if number % 2 else 1]:
                robots.stop_one(kind, samples)
        for kind in KINDS:
            show_step(f"pebble estop of {kind}")
            robots.stop_by_command(kind, samples)
        if plan.boards:
            show_step(f"{plan.boards} boards start while a stop is held")
            robots.hold_boards(samples)
        for number in range(plan.all_stops):
            show_step(f"stop {number + 1} of {plan.all_stops} of all robots")
            robots.stop_all(samples)
    return samples
