"""Compares ways of transferring camera frames between processes, in turn on one machine.

One process writes BGR pictures at 30 Hz, one or three others read them. The latency is from the last byte written until
a reader has a whole numpy array. Every case starts new processes in every round: starts of a process differ more than
frames of one process, so many short rounds are better than a few long ones. The first frames do not count.

``zenoh-shm``: created in the shared segment and read as a view. ``mqtt``: mosquitto and paho, QoS 0. ``gstreamer-shm``:
shmsink to shmsrc, as in the original, with the system's Python.
"""

from __future__ import annotations

import subprocess
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from statistics import fmean
from typing import Final

from rich.console import Console
from rich.table import Table

from pebble.errors import PebbleError
from pebble.extensions.lab.bench import plots
from pebble.extensions.lab.bench.results import Cell, Params, Results, begin, grouped, round_cell
from pebble.extensions.lab.bench.rounds import Progress, in_turn, measure_rounds
from pebble.extensions.lab.bench.show import RATIOS, Shown, compared, percentiles, plain_table
from pebble.extensions.lab.bench.usage import cpu_s, pss_mb
from pebble.extensions.lab.rig.processes import Processes, python
from pebble.extensions.operator.places import mosquitto_path

VARIANTS: Final = ("zenoh-shm", "mqtt", "gstreamer-shm")
BASELINE: Final = "mqtt"
INSTALL_GSTREAMER: Final = (
    "apt-get install -y --no-install-recommends gstreamer1.0-plugins-base gstreamer1.0-plugins-bad"
    " gir1.2-gst-plugins-base-1.0 python3-gst-1.0 python3-numpy"
)
SYSTEM_PYTHON = "/usr/bin/python3"  # the only one that Debian's gi and Gst can be imported into
_PLAIN_WORKER = str(Path(__file__).with_name("frames_worker.py"))
_PROBE_S = 20.0
_READY_S = 20.0
_STARTUP_S = 0.1  # from the last process ready to the first counted frame
_LATE_S = 0.15  # how long to wait for the last frames after the window
_ANSWER_S = 10.0


@dataclass(frozen=True, slots=True)
class Settings:
    """The cases, and the ``seconds`` for which each is measured per round."""

    variants: Sequence[str] = VARIANTS
    size: Sequence[str] = ("640x480", "1920x1080")
    readers: Sequence[int] = (1, 3)
    seconds: float = 0.5
    rounds: int = 8


FULL: Final = Settings()
QUICK: Final = Settings(size=("640x480",), readers=(1,), rounds=2)


def run(settings: Settings, console: Console) -> Shown:
    """Measure all variants that can run on this machine. Raises PebbleError."""
    reasons = {variant: why for variant in settings.variants if (why := missing(variant)) is not None}
    variants = [variant for variant in settings.variants if variant not in reasons]
    if not variants:
        raise PebbleError(f"no variant can be measured on this machine: {'; '.join(reasons.values())}")
    results = begin("frames", replace(settings, variants=variants))
    results.notes += [f"{variant} is left out: {why}" for variant, why in reasons.items()]
    conditions: list[Params] = [
        {"size": size, "readers": readers} for size, readers in product(settings.size, settings.readers)
    ]
    cases = list(product(conditions, variants))

    def measure_round(number: int, progress: Progress) -> Iterator[Cell]:
        for condition, variant in in_turn(cases, number):
            progress(f"{variant}, {condition['size']}, {condition['readers']} readers")
            yield measure(variant, condition, settings.seconds)

    measure_rounds(results, settings.rounds, measure_round, console)
    return Shown(results, [table(results)], plots.curves("frames", "Frames between processes", results.cells))


def missing(variant: str) -> str | None:
    """Return why this variant cannot run on this machine, and what to install; None if it can."""
    if variant == "mqtt" and mosquitto_path() is None:
        return "mosquitto is not installed: apt-get install -y --no-install-recommends mosquitto"
    if variant == "gstreamer-shm":
        try:
            subprocess.run([SYSTEM_PYTHON, _PLAIN_WORKER], capture_output=True, timeout=_PROBE_S, check=True)
        except (OSError, subprocess.SubprocessError) as error:
            return f"{SYSTEM_PYTHON} has no GStreamer ({error}): {INSTALL_GSTREAMER}"
    return None


def measure(variant: str, condition: Params, seconds: float) -> Cell:
    """Return the results of one writer and its readers, each a process. Raises PebbleError if one of them fails.

    CPU is in % of one core, memory (PSS) in MB; for the readers they are means.
    """
    is_gstreamer = variant == "gstreamer-shm"
    program = [SYSTEM_PYTHON, _PLAIN_WORKER] if is_gstreamer else python("pebble.extensions.lab.bench.frames_worker")
    with Processes() as processes:
        broker = processes.broker() if variant == "mqtt" else None
        if broker is not None:
            broker.wait()
        where = processes.folder if broker is None else broker.port
        for number, role in enumerate(("writer", *["reader"] * int(condition["readers"] or 0))):
            options = map(str, (variant, role, where, condition["size"]))
            worker = processes.command(f"{variant}: {role} {number}", [*program, *options])
            if is_gstreamer and role == "writer":  # its readers fail without a writer; the others wait
                worker.answer(_READY_S)
        workers = processes.workers
        for worker in workers[1:] if is_gstreamer else workers:  # that writer has answered
            worker.answer(_READY_S)
        pids = [process.pid for process in (*workers, *([broker] if broker else []))]
        time.sleep(_STARTUP_S)
        before, began_ns = [cpu_s([pid]) for pid in pids], time.monotonic_ns()
        time.sleep(seconds)
        window = range(began_ns, time.monotonic_ns())
        cpu = [100 * (cpu_s([pid]) - so_far) / seconds for pid, so_far in zip(pids, before, strict=True)]
        time.sleep(_LATE_S)
        writer, *readers = (worker.ask("", _ANSWER_S) for worker in workers)
        memory_mb = [pss_mb(worker.pid) for worker in workers]
        cpu_writer, *cpu_readers = cpu[: len(workers)]
    latencies_us = [(ns - stamp) / 1000 for reader in readers for stamp, ns in reader["arrived"] if stamp in window]
    return round_cell(
        variant, "frame", "us", latencies_us, condition,
        sent=sum(stamp in window for stamp in writer["stamps"]) * len(readers),  # each frame to each reader
        torn=sum(reader["torn"] for reader in readers),
        cpu_writer=cpu_writer, cpu_reader=fmean(cpu_readers), memory_writer_mb=memory_mb[0],
        memory_reader_mb=fmean(memory_mb[1:]), **({} if broker is None else {"cpu_broker": cpu[-1]}),
    )  # fmt: skip


def table(results: Results) -> Table:
    """Return the latency, CPU and memory of each variant, for each size and number of readers."""
    grid = plain_table(
        "BGR at 30 Hz",
        ["size", "readers", "variant", "p50 µs", "p99 µs", "max µs", "CPU %", "PSS MB", "n", "lost", "torn",
         f"to {BASELINE}"],
        left=3, caption=f"CPU: writer / each reader / broker; PSS: writer / each reader. {RATIOS}",
    )  # fmt: skip
    for place, cells in grouped(results.cells, lambda cell: tuple(cell.params.values())).items():
        grid.add_section()
        for ours in sorted(cells, key=lambda cell: VARIANTS.index(cell.variant)):
            base = results.find(BASELINE, "frame", **ours.params)
            grid.add_row(
                *map(str, place), ours.variant, *percentiles(ours, 50, 99, 100),
                _beside(ours, "cpu_writer", "cpu_reader", "cpu_broker"),
                _beside(ours, "memory_writer_mb", "memory_reader_mb"), str(len(ours.samples)), str(ours.lost),
                str(ours.total("torn")), compared(ours, base),
            )  # fmt: skip
    return grid


def _beside(cell: Cell, *names: str) -> str:
    """Return a cell's figures in one line."""
    values = [cell.middle(name) for name in names if name in cell.figures]
    return " / ".join(f"{value:.0f}" if value >= 20 else f"{value:.1f}" for value in values)
