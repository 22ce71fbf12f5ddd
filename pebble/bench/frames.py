"""Compares ways of handing camera frames to other processes, side by side in one run on one machine."""

from __future__ import annotations

import json
import statistics
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from pebble.bench.figures import LONGEST_S
from pebble.bench.frames_process import Worker, end_workers
from pebble.bench.frames_report import Round, as_json, legend, ratios, row_of, tables
from pebble.bench.frames_variants import VARIANTS, Case, missing, parse_size
from pebble.bench.usage import cpu_s, pss_mb
from pebble.demo.broker import Broker, BrokerKind
from pebble.demo.programs import end_all
from pebble.errors import PebbleError
from pebble.signals import interrupted_by_signals
from pebble.transports.segments import sweep

SIZES = ("640x480", "1920x1080")
READERS = (1, 3)
_READY_S = 20.0
_AROUND_S = 2.2  # starting and ending the processes of a case, for the estimate
_SETTLE_S = 0.3  # from “everybody is ready” to the first frame that counts
_ANSWER_S = 10.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """What to compare. One round runs every case once, for ``seconds``; figures are medians over the rounds."""

    seconds: float = 3.0
    rounds: int = 3
    sizes: Sequence[str] = SIZES
    readers: Sequence[int] = READERS
    variants: Sequence[str] = VARIANTS
    json: Path | None = None

    def check(self) -> None:
        """Raises PebbleError naming what makes no sense."""
        unknown = [name for name in self.variants if name not in VARIANTS]
        if unknown:
            raise PebbleError(f"unknown variant {', '.join(unknown)}: there are {', '.join(VARIANTS)}")
        if not 0 < self.seconds <= LONGEST_S or self.rounds < 1 or min(self.readers, default=0) < 1:
            raise PebbleError(f"seconds, rounds and readers must be positive, and seconds at most {LONGEST_S:.0f}")
        if self.json is not None and not self.json.resolve().parent.is_dir():
            raise PebbleError(f"{self.json}: there is no such folder")


def run(plan: Plan, console: Console | None = None) -> int:
    """Measure and show; 0 if every case that this machine can run gave figures. Raises PebbleError.

    Variants whose programs are not installed are left out, with the reason.
    """
    console = console or Console()
    plan.check()
    sizes = [parse_size(size) for size in plan.sizes]
    variants = _installed(plan.variants, console)
    cases = [Case(name, size, readers) for size in sizes for readers in plan.readers for name in variants]
    minutes = plan.rounds * len(cases) * (plan.seconds + _AROUND_S) / 60
    console.print(f"{len(cases)} cases, {plan.rounds} rounds of {plan.seconds:g} s: about {minutes:.1f} min")
    with interrupted_by_signals():
        try:
            measured = _measure(cases, plan, console)
        finally:
            sweep()  # Zenoh leaves a file behind even when it ends politely
    rows = [row_of(case, rounds) for case, rounds in measured.items() if rounds]
    for line in legend(variants):
        console.print(line, style="dim", highlight=False)
    for figures in tables(rows):
        console.print(figures)
    for line in ratios(rows):
        console.print(line, highlight=False)
    if plan.json is not None:
        plan.json.write_text(json.dumps(as_json(rows), indent=1) + "\n")
        console.print(f"Written to {plan.json}", soft_wrap=True)
    return 0 if rows and all(row.n for row in rows) and len(rows) == len(cases) else 1


def _installed(variants: Sequence[str], console: Console) -> list[str]:
    reasons = {name: missing(name) for name in variants}
    for name, reason in reasons.items():
        if reason is not None:
            console.print(f"{name} is left out: {reason}", style="yellow", highlight=False, soft_wrap=True)
    return [name for name in variants if reasons[name] is None]


def _measure(cases: Sequence[Case], plan: Plan, console: Console) -> dict[Case, list[Round]]:
    """Every case in every round: what disturbs the machine for a while disturbs all of them."""
    measured: dict[Case, list[Round]] = {case: [] for case in cases}
    progress = Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), console=console,
        transient=True,
    )  # fmt: skip
    with progress:
        bar = progress.add_task("frames", total=plan.rounds * len(cases))
        for number in range(plan.rounds):
            for case in cases[:: -1 if number % 2 else 1]:
                progress.update(bar, description=f"round {number + 1}: {case}")
                try:
                    measured[case].append(run_case(case, plan.seconds))
                except PebbleError as error:
                    console.print(f"{case}: {error}", style="red", highlight=False, markup=False, soft_wrap=True)
                progress.advance(bar)
    return measured


def run_case(case: Case, seconds: float) -> Round:
    """One writer and its readers, each a process, from start to end. Raises PebbleError if one of them fails."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="pbl-")))
        broker = stack.enter_context(_broker(folder)) if case.needs_broker else None
        port = broker.port if broker is not None else 0
        workers: list[Worker] = []
        stack.callback(lambda: end_workers(workers))
        workers.append(Worker(f"{case}: writer", case.command("writer", folder, port), folder / "writer.log"))
        workers[0].answer(_READY_S)
        for number in range(case.readers):
            name = f"reader {number + 1}"
            workers.append(Worker(f"{case}: {name}", case.command("reader", folder, port), folder / f"{name}.log"))
        for worker in workers[1:]:
            worker.answer(_READY_S)
        return _observe(case, workers, broker, seconds)


def _observe(case: Case, workers: Sequence[Worker], broker: Broker | None, seconds: float) -> Round:
    begin = time.monotonic_ns() + int(_SETTLE_S * 1e9)
    for worker in workers:
        worker.tell(f"{begin} {begin + int(seconds * 1e9)}")
    time.sleep(_SETTLE_S)
    before = cpu_s([broker.program.pid]) if broker is not None else 0.0
    time.sleep(seconds)
    used = cpu_s([broker.program.pid]) - before if broker is not None else None
    said = [worker.answer(_ANSWER_S) for worker in workers]
    bare = case.variant == "memcpy"  # nobody's writer
    return Round(
        latencies_us=[latency for reader in said[1:] for latency in reader["latencies_us"]],
        sent=said[0]["sent"],
        fallbacks=said[0]["fallbacks"],
        torn=sum(reader["torn"] for reader in said[1:]),
        cpu_writer=0.0 if bare else said[0]["cpu"],
        cpu_reader=statistics.fmean(reader["cpu"] for reader in said[1:]),
        cpu_broker=None if used is None else 100 * used / seconds,
        memory_writer_mb=0.0 if bare else pss_mb(workers[0].pid),
        memory_reader_mb=0.0 if bare else statistics.fmean(pss_mb(worker.pid) for worker in workers[1:]),
    )


@contextmanager
def _broker(folder: Path) -> Iterator[Broker]:
    broker = Broker("bench-broker", BrokerKind.MOSQUITTO, folder)
    try:
        broker.wait(threading.Event())
        yield broker
    finally:
        end_all([broker.program], 1.0)
