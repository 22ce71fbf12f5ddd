"""Measures memory, CPU and threads of each process of a robot, idle and active, on MQTT and on Zenoh.

Whole robots with a synthetic camera and microphone, stock mosquitto, a simulated MCU. The phases have a fixed order;
each starts with the memory that the one before left allocated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from rich.console import Console

from pebble.bench.cost_cells import cells_of
from pebble.bench.cost_robot import RATE_HZ, STREAMS, measure
from pebble.bench.output import FOLDER, check_folder, finish
from pebble.bench.percentiles import LONGEST_S
from pebble.bench.results import Stopwatch
from pebble.bench.rounds import Rounds
from pebble.errors import PebbleError
from pebble.rig.robot import KINDS, check_kinds
from pebble.runtime.signals import interrupted_by_signals
from pebble.transports.segments import sweep

ROUNDS, QUICK_ROUNDS = 8, 1
SECONDS, QUICK_SECONDS = 1.5, 0.7


@dataclass(frozen=True, slots=True, kw_only=True)
class CostPlan:
    """Each round starts a fresh robot of each kind and runs each phase for ``seconds``."""

    rounds: int | None = None  # None: the default
    seconds: float | None = None
    kinds: Sequence[str] = KINDS
    quick: bool = False
    output: Path = FOLDER

    @property
    def robots(self) -> int:
        return self.rounds or (QUICK_ROUNDS if self.quick else ROUNDS)

    @property
    def phase_s(self) -> float:
        return self.seconds or (QUICK_SECONDS if self.quick else SECONDS)

    def check(self) -> None:
        """Raises PebbleError naming an invalid option."""
        check_kinds(self.kinds)
        if not 0 < self.phase_s <= LONGEST_S:
            raise PebbleError(f"seconds must be positive, and at most {LONGEST_S:.0f}")
        check_folder(self.output)

    def command(self) -> list[str]:
        """The command line that repeats the run."""
        kinds = [] if tuple(self.kinds) == KINDS else ["--variants", ",".join(self.kinds)]
        amount = ["--rounds", str(self.robots), "--seconds", f"{self.phase_s:g}"]
        return ["pebble", "bench", "cost", *amount, *kinds, *(["--quick"] if self.quick else [])]


def run(plan: CostPlan, console: Console | None = None) -> int:
    """Measures, prints and writes; returns 0 if everything has results of enough rounds. Raises PebbleError."""
    console = console or Console()
    plan.check()
    streams = _installed(console)
    options = {"rounds": plan.robots, "seconds": plan.phase_s, "rate_hz": RATE_HZ}
    watch = Stopwatch("cost", plan.command(), options)
    rounds, done = Rounds(plan.robots, console), []
    with interrupted_by_signals(), console.status("") as status:
        try:
            for number in range(plan.robots):
                with rounds.attempt(number):
                    one = {}
                    for kind in plan.kinds[:: -1 if number % 2 else 1]:
                        status.update(f"round {number + 1} of {plan.robots}: {kind}")
                        one[kind] = measure(kind, plan.phase_s, streams)
                    done.append(one)
        finally:
            sweep()  # Zenoh leaves files behind even after a regular end
    from pebble.bench.cost_report import (  # numpy: importing it earlier would change the robots' PSS
        assessment,
        legend,
        table,
    )

    cells = cells_of({kind: [one[kind] for one in done] for kind in plan.kinds})
    console.print(table(cells))
    for line in legend(cells):
        console.print(line, style="dim", highlight=False, soft_wrap=True)
    finish(watch.results(cells, [*rounds.notes(), *assessment(cells)], quick=plan.quick), plan.output, console)
    return rounds.code(cells)


def _installed(console: Console) -> list[str]:
    """The media phases that this machine can run; prints which one is left out."""
    if find_spec("av") is not None:
        return list(STREAMS)
    console.print("h264+opus is left out: pip install 'pebble-robot[media]'", style="yellow", highlight=False)
    return ["json+pcm"]
