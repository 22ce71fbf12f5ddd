"""Compares ways of transferring camera frames between processes, in turn on one machine."""

from __future__ import annotations

import itertools
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from pebble.bench.comparison import FOLDER
from pebble.bench.engine import check_folder, finish
from pebble.bench.frames_report import Round, assessment, cell_of, complete, legend, tables
from pebble.bench.frames_variants import VARIANTS, Case, missing, parse_size
from pebble.bench.ratios import LEAST_ROUNDS
from pebble.bench.results import LONGEST_S, Cell, Stopwatch, Value
from pebble.bench.usage import cpu_s, pss_mb
from pebble.errors import PebbleError
from pebble.rig.broker import Broker
from pebble.rig.processes import Processes
from pebble.rig.worker import Worker
from pebble.runtime.signals import interrupted_by_signals
from pebble.transports.segments import sweep

SIZES = ("640x480", "1920x1080")
READERS = (1, 3)
_LEAST_ROUNDS = 2  # one shows no variation
_READY_S = 20.0
_AROUND_S = 1.15  # to start and end the processes of a case, for the estimate
_STARTUP_S = 0.1  # from the last process ready to the first counted frame
_ANSWER_S = 10.0

Measured = Mapping[Case, list[Round | None]]  # None: a round that failed


@dataclass(frozen=True, slots=True, kw_only=True)
class FramesPlan:
    """The options of a run. One round runs every case once for ``seconds``, with processes of its own."""

    seconds: float = 0.5
    rounds: int = LEAST_ROUNDS
    sizes: Sequence[str] = SIZES
    readers: Sequence[int] = READERS
    variants: Sequence[str] = VARIANTS
    output: Path = FOLDER
    quick: bool = False  # the results are marked as quick

    def check(self) -> None:
        """Raises PebbleError naming an invalid option."""
        unknown = [name for name in self.variants if name not in VARIANTS]
        if unknown or not self.variants:
            raise PebbleError(f"unknown variant {', '.join(unknown)}: there are {', '.join(VARIANTS)}")
        if not 0 < self.seconds <= LONGEST_S:
            raise PebbleError(f"seconds must be positive, and at most {LONGEST_S:.0f}")
        if self.rounds < _LEAST_ROUNDS or min(self.readers, default=0) < 1:
            raise PebbleError(f"at least {_LEAST_ROUNDS} rounds and one reader are needed")
        if any(len(set(some)) < len(some) for some in (self.variants, self.sizes, self.readers)):
            raise PebbleError("a variant, size or number of readers is named twice")
        for size in self.sizes:
            parse_size(size)
        check_folder(self.output)

    def options(self) -> dict[str, Value | list[Value]]:
        """All options that affect the results."""
        return {
            "seconds": self.seconds,
            "rounds": self.rounds,
            "sizes": list(self.sizes),
            "readers": list(self.readers),
            "variants": list(self.variants),
        }

    def command(self) -> list[str]:
        """The command line that repeats the run."""
        words = ["pebble", "bench", "frames", "--seconds", f"{self.seconds:g}", "--rounds", str(self.rounds)]
        words += itertools.chain(*(("--size", size) for size in self.sizes))
        words += itertools.chain(*(("--readers", str(count)) for count in self.readers))
        return [*words, "--variants", ",".join(self.variants), *(["--quick"] if self.quick else [])]


def plan(*, quick: bool = False, **given: Any) -> FramesPlan:
    """The default or quick plan, with the ``given`` options replaced."""
    usual = {"rounds": 2, "seconds": 0.5, "sizes": SIZES[:1], "readers": READERS[:1]} if quick else {}
    return FramesPlan(quick=quick, **{**usual, **given})


def run(plan: FramesPlan, console: Console | None = None) -> int:
    """Measures, prints and writes; returns 0 if every available case has results of enough rounds. Raises PebbleError.

    Variants whose programs are not installed are left out, with the reason.
    """
    console = console or Console()
    plan.check()
    watch = Stopwatch("frames", plan.command(), plan.options())
    variants = _installed(plan.variants, console)
    cases = [
        Case(name, parse_size(size), readers) for size in plan.sizes for readers in plan.readers for name in variants
    ]
    if not cases:
        return 1
    cells = cells_of(measure(cases, plan, console))
    for line in legend(variants):
        console.print(line, style="dim", highlight=False)
    for figures in tables(cells):
        console.print(figures)
    finish(watch.results(cells, assessment(cells), quick=plan.quick), plan.output, console)
    return 0 if complete(cells, plan.rounds) else 1


def _installed(variants: Sequence[str], console: Console) -> list[str]:
    reasons = {name: missing(name) for name in variants}
    for name, reason in reasons.items():
        if reason is not None:
            console.print(f"{name} is left out: {reason}", style="yellow", highlight=False, soft_wrap=True)
    return [name for name in variants if reasons[name] is None]


def cells_of(measured: Measured) -> list[Cell]:
    return [cell_of(case, rounds) for case, rounds in measured.items()]


def measure(
    cases: Sequence[Case],
    plan: FramesPlan,
    console: Console,
    slower_us: Callable[[Case, Measured], float] = lambda _case, _so_far: 0.0,
) -> Measured:
    """Runs every case in every round, so that a temporary disturbance affects all of them.

    ``slower_us`` returns, from the measurements so far, how long a case's writer delays each frame.
    """
    minutes = plan.rounds * len(cases) * (plan.seconds + _AROUND_S) / 60
    console.print(f"{len(cases)} cases, {plan.rounds} rounds of {plan.seconds:g} s: about {minutes:.1f} min")
    measured: dict[Case, list[Round | None]] = {case: [] for case in cases}
    progress = Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), console=console,
        transient=True,
    )  # fmt: skip
    with interrupted_by_signals(), _swept(), progress:
        bar = progress.add_task("frames", total=plan.rounds * len(cases))
        for number in range(plan.rounds):
            for case in cases[:: -1 if number % 2 else 1]:
                progress.update(bar, description=f"round {number + 1}: {case}")
                held_up = replace(case, slower_us=slower_us(case, measured))
                measured[case].append(_try_case(held_up, plan.seconds, console))
                progress.advance(bar)
    return measured


@contextmanager
def _swept() -> Iterator[None]:
    try:
        yield
    finally:
        sweep()  # Zenoh leaves a file behind even after a regular end


def _try_case(case: Case, seconds: float, console: Console) -> Round | None:
    try:
        return run_case(case, seconds)
    except PebbleError as error:
        console.print(f"{case}: {error}", style="red", highlight=False, markup=False, soft_wrap=True)
        return None


def run_case(case: Case, seconds: float) -> Round:
    """Runs one writer and its readers, each as a process. Raises PebbleError if one of them fails."""
    with Processes() as processes:
        broker = processes.broker() if case.needs_broker else None
        if broker is not None:
            broker.wait()
        workers: list[Worker] = []
        for name in ("writer", *(f"reader {number + 1}" for number in range(case.readers))):
            command = case.command(name.partition(" ")[0], processes.folder, broker.port if broker is not None else 0)
            workers.append(processes.command(f"{case}: {name}", command))
            if name == "writer" and case.needs_writer_first:
                workers[0].answer(_READY_S)
        for worker in workers[1 if case.needs_writer_first else 0 :]:
            worker.answer(_READY_S)
        return _observe(case, workers, broker, seconds)


def _observe(case: Case, workers: Sequence[Worker], broker: Broker | None, seconds: float) -> Round:
    begin = time.monotonic_ns() + int(_STARTUP_S * 1e9)
    for worker in workers:
        worker.send(f"{begin} {begin + int(seconds * 1e9)}")
    time.sleep(_STARTUP_S)
    before = cpu_s([broker.pid]) if broker is not None else 0.0
    time.sleep(seconds)
    used = cpu_s([broker.pid]) - before if broker is not None else None
    answers = [worker.answer(_ANSWER_S) for worker in workers]
    bare = case.variant == "memcpy"  # has no writer
    return Round(
        latencies_us=[latency for reader in answers[1:] for latency in reader["latencies_us"]],
        sent=answers[0]["sent"],
        fallbacks=answers[0]["fallbacks"],
        torn=sum(reader["torn"] for reader in answers[1:]),
        cpu_writer=0.0 if bare else answers[0]["cpu"],
        cpu_reader=statistics.fmean(reader["cpu"] for reader in answers[1:]),
        cpu_broker=None if used is None else 100 * used / seconds,
        memory_writer_mb=0.0 if bare else pss_mb(workers[0].pid),
        memory_reader_mb=0.0 if bare else statistics.fmean(pss_mb(worker.pid) for worker in workers[1:]),
    )
