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
from pebble.extensions.lab.bench.usage import cpu_s
from pebble.extensions.lab.rig.processes import Processes, Worker, python
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
_CPU = ("cpu_writer", "cpu_reader", "cpu_broker")  # names of figures


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
    obstacles = {variant: missing(variant) for variant in settings.variants}
    variants = [variant for variant, obstacle in obstacles.items() if not obstacle]
    if not variants:
        raise PebbleError(f"no variant can be measured on this machine: {'; '.join(obstacles.values())}")
    results = begin("frames", replace(settings, variants=variants))
    results.notes += [f"{variant} is left out: {obstacle}" for variant, obstacle in obstacles.items() if obstacle]
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


def missing(variant: str) -> str:
    """Return why this variant cannot run on this machine, and what to install; empty if it can."""
    if variant == "mqtt" and mosquitto_path() is None:
        return "mosquitto is not installed: apt-get install -y --no-install-recommends mosquitto"
    if variant == "gstreamer-shm":
        try:
            subprocess.run([SYSTEM_PYTHON, _PLAIN_WORKER], capture_output=True, timeout=_PROBE_S, check=True)
        except (OSError, subprocess.SubprocessError) as error:
            return f"{SYSTEM_PYTHON} has no GStreamer ({error}): {INSTALL_GSTREAMER}"
    return ""


def measure(variant: str, condition: Params, seconds: float) -> Cell:
    """Return the results of one writer and its readers, each a process. Raises PebbleError if one of them fails.

    CPU is in % of one core; for the readers it is the mean.
    """
    is_gstreamer = variant == "gstreamer-shm"
    program = [SYSTEM_PYTHON, _PLAIN_WORKER] if is_gstreamer else python("pebble.extensions.lab.bench.frames_worker")
    with Processes() as processes:
        broker = processes.broker() if variant == "mqtt" else None
        if broker is not None:
            broker.wait()
        where = processes.folder if broker is None else broker.port

        def start(role: str, name: str) -> Worker:
            options = map(str, (variant, role, where, condition["size"]))
            return processes.command(f"{variant}: {name}", [*program, *options])

        writer = start("writer", "writer")
        writer.answer(_READY_S)  # first: a reader of GStreamer fails without a writer
        readers = [start("reader", f"reader {number}") for number in range(int(condition["readers"] or 0))]
        for reader in readers:
            reader.answer(_READY_S)
        time.sleep(_STARTUP_S)
        measured = [writer, *readers] if broker is None else [writer, *readers, broker]  # the order of all CPU times
        before, began_ns = [cpu_s([program.pid]) for program in measured], time.monotonic_ns()
        time.sleep(seconds)
        window = range(began_ns, time.monotonic_ns())
        after = [cpu_s([program.pid]) for program in measured]
        time.sleep(_LATE_S)
        written, *read = (worker.ask("", _ANSWER_S) for worker in (writer, *readers))
    cpu_writer, *cpu_others = [100 * (now - earlier) / seconds for now, earlier in zip(after, before, strict=True)]
    latencies_us = [(ns - stamp) / 1000 for answer in read for stamp, ns in answer["arrived"] if stamp in window]
    figures = {
        "sent": sum(stamp in window for stamp in written["stamps"]) * len(read),  # each frame to each reader
        "cpu_writer": cpu_writer, "cpu_reader": fmean(cpu_others[: len(readers)]),
    }  # fmt: skip
    if broker is not None:
        figures["cpu_broker"] = cpu_others[-1]
    return round_cell(variant, "frame", "us", latencies_us, condition, **figures)


def table(results: Results) -> Table:
    """Return the latency and CPU of each variant, for each size and number of readers."""
    grid = plain_table(
        "BGR at 30 Hz",
        ["size", "readers", "variant", "p50 µs", "p99 µs", "max µs", "CPU %", "n", "lost", f"to {BASELINE}"],
        left=3, caption=f"CPU: writer / each reader / broker. {RATIOS}",
    )  # fmt: skip
    for condition, cells in grouped(results.cells, lambda cell: tuple(cell.params.values())).items():
        grid.add_section()
        for ours in sorted(cells, key=lambda cell: VARIANTS.index(cell.variant)):
            base = results.find(BASELINE, "frame", **ours.params)
            grid.add_row(
                *map(str, condition), ours.variant, *percentiles(ours, 50, 99, 100),
                " / ".join(f"{ours.middle(name):.1f}" for name in _CPU if name in ours.figures),
                str(len(ours.samples)), str(ours.lost), compared(ours, base),
            )  # fmt: skip
    return grid
