"""Compares ways of transferring camera frames between processes, in turn on one machine."""

from __future__ import annotations

import statistics
import subprocess
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from pebble.bench.comparison import (
    Budget,
    Case,
    Comparison,
    Measuring,
    Option,
    Report,
    Run,
    of_known,
    rounds,
    seconds,
    variants,
)
from pebble.bench.judging import null
from pebble.bench.judging.ratios import LEAST_ROUNDS, paired
from pebble.bench.pictures import ecdf, null_ratios, tails
from pebble.bench.results import Cell, Value
from pebble.bench.tables import COUNT, LOST, Column, Grid, percentile_column
from pebble.bench.usage import cpu_s, pss_mb
from pebble.errors import PebbleError
from pebble.rig.processes import Processes, mosquitto_path, python

VARIANTS = ("zenoh-shm", "zenoh-copy", "zenoh-net", "mqtt", "gstreamer-shm", "memcpy")
OURS = "zenoh-shm"
SIZES = ("640x480", "1280x720", "1920x1080")
INSTALL_GSTREAMER = (
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
_CPU, _MEMORY = ("cpu_writer", "cpu_reader", "cpu_broker"), ("memory_writer_mb", "memory_reader_mb")


def prepare(run: Run) -> None:
    if run.comparison.is_null and "variants" in run.options:
        raise PebbleError("--null names the variant: leave --variants out")


def missing(variant: str) -> str | None:
    """Why this variant cannot run on this machine, with what installs it; None if it can."""
    if variant == "mqtt" and mosquitto_path() is None:
        return "mosquitto is not installed: apt-get install -y --no-install-recommends mosquitto"
    if variant == "gstreamer-shm":
        try:
            subprocess.run([SYSTEM_PYTHON, _PLAIN_WORKER], capture_output=True, timeout=_PROBE_S, check=True)
        except (OSError, subprocess.SubprocessError) as error:
            return f"{SYSTEM_PYTHON} has no GStreamer ({error}): {INSTALL_GSTREAMER}"
    return None


def measure(case: Case) -> Iterator[Cell]:
    """Runs one writer and its readers, each as a process. Raises PebbleError if one of them fails.

    CPU is in % of one core, memory (PSS) in MB; those of the readers are their mean.
    """
    is_gstreamer, seconds = case.variant == "gstreamer-shm", case.run["seconds"]
    program = [SYSTEM_PYTHON, _PLAIN_WORKER] if is_gstreamer else python("pebble.bench.frames_worker")
    with Processes() as processes:
        broker = processes.broker() if case.variant == "mqtt" else None
        if broker is not None:
            broker.wait()
        where = processes.folder if broker is None else broker.port
        for number, role in enumerate(("writer", *["reader"] * int(case.condition["readers"] or 0))):
            options = (case.variant, role, where, case.condition["size"], case.planted_us * case.slowed)
            worker = processes.command(f"{case}: {role} {number}", [*program, *map(str, options)])
            if is_gstreamer and role == "writer":  # its readers fail without a writer; the others wait
                worker.answer(_READY_S)
        workers = processes.workers
        for worker in workers[is_gstreamer:]:
            worker.answer(_READY_S)
        begin = time.monotonic_ns() + int(_STARTUP_S * 1e9)
        for worker in workers:
            worker.send(f"{begin} {begin + int(seconds * 1e9)}")
        pids = [process.pid for process in (*workers, *([broker] if broker else []))]
        time.sleep(_STARTUP_S)
        before = [cpu_s([pid]) for pid in pids]
        time.sleep(seconds)
        cpu = [100 * (cpu_s([pid]) - so_far) / seconds for pid, so_far in zip(pids, before, strict=True)]
        time.sleep(_LATE_S)
        writer, *readers = (worker.ask("", _ANSWER_S) for worker in workers)
        memory_mb = [pss_mb(worker.pid) for worker in workers]
    latencies_us = [latency for reader in readers for latency in reader["latencies_us"]]
    figures: dict[str, Value] = {
        "cpu_writer": cpu[0],
        "cpu_reader": statistics.fmean(cpu[1 : len(workers)]),
        "cpu_broker": None if broker is None else cpu[-1],
        "memory_writer_mb": memory_mb[0],
        "memory_reader_mb": statistics.fmean(memory_mb[1:]),
        "sent": writer["sent"] * len(readers),  # each frame to each reader
    }
    if case.variant == "memcpy":  # copies are timed, not what was sent
        figures = {"cpu_reader": sum(latencies_us) / 1e4 / seconds / len(readers)}
    figures |= {"torn": sum(reader["torn"] for reader in readers), "fallbacks": writer["fallbacks"]}
    yield case.cell("frame", "us", latencies_us, None, **figures)


# -- the report


def assessment(cells: Sequence[Cell]) -> Iterator[str]:
    """Compares frames without copies with each other variant, one line each."""
    for ours in (cell for cell in cells if cell.variant == OURS):
        for theirs in (cell for cell in cells if cell is not ours and cell.params == ours.params):
            yield f"{_conditions(ours)}: {paired(ours.rounds, theirs.rounds).words(OURS, theirs.variant)}"


def faults(cells: Sequence[Cell]) -> Iterator[str]:
    """Failed rounds, and frames that did not arrive as they should."""
    words = {"torn": "frames arrived torn", "fallbacks": "frames could not go through shared memory"}
    for cell in cells:
        where, failed = f"{_conditions(cell)}, {cell.variant}", sum(not one for one in cell.rounds)
        if failed:
            yield f"{where}: {failed} rounds failed and are left out"
        yield from (f"{where}: {cell.figures[name]} {what}" for name, what in words.items() if cell.figures.get(name))


def complete(cells: Sequence[Cell]) -> bool:
    """Whether every case has results, of enough of its rounds to judge."""
    return all(
        sum(map(bool, cell.rounds)) >= (LEAST_ROUNDS if len(cell.rounds) >= LEAST_ROUNDS else 1) for cell in cells
    )


def _conditions(cell: Cell) -> str:
    count = cell.params["readers"]
    return f"{cell.params['size']}, {'one reader' if count == 1 else f'{count} readers'}"


def _column(head: str, *names: str) -> Column:
    """Single values side by side."""

    def value(cell: Cell) -> str:
        known = [one for name in names if isinstance(one := cell.figures.get(name), (int, float))]
        return " / ".join(f"{one:.0f}" if one >= 20 else f"{one:.1f}" for one in known)

    return Column(head, value)


FRAMES = Comparison(
    name="frames",
    title="Camera frames inside the robot",
    what="BGR pictures at 30 Hz from one process to others on the same machine. The latency is from the last byte "
    "written until the reader has a whole numpy array.",
    help="Camera frames from one process to others: latency, CPU and memory.",
    options=(
        seconds("Duration of each case in a round."),
        rounds("Rounds of all cases.", least=2),  # one shows no variation
        Option(name="size", many=True, known=SIZES, metavar="SIZES", help="Some of " + ", ".join(SIZES) + "."),
        Option(name="readers", kind=int, many=True, least=1, most=16, metavar="COUNTS", help="For example 1,3."),
        variants(VARIANTS),
        Option(
            name="null", known=VARIANTS, metavar="VARIANT", recorded=False,
            help="Only this one, against itself and against itself slowed by a fifth.",
        ),
    ),
    full=Budget(300, seconds=0.5, rounds=LEAST_ROUNDS, size=("640x480", "1920x1080"), readers=(1, 3), null=None),
    quick=Budget(20, rounds=2, size=("640x480",), readers=(1,)),
    variants=VARIANTS,
    conditions=lambda run: [{"size": size, "readers": count} for size in run["size"] for count in run["readers"]],
    measuring=Measuring(
        prepare=prepare,
        missing=missing,
        measure=measure,
        alone=True,
        measures=("frame",),
        figures={
            **dict.fromkeys(("torn", "fallbacks"), sum),
            **dict.fromkeys((*_CPU, *_MEMORY), of_known(statistics.median, 2)),
        },
    ),
    report=Report(
        tables=(
            Grid(
                title="{size} BGR at 30 Hz, readers: {readers}", each=("size", "readers"), rows=("variant",),
                columns=(
                    percentile_column(50, "p50 µs"), percentile_column(99, "p99 µs"), percentile_column(100, "max µs"),
                    _column("CPU %", *_CPU), _column("PSS MB", *_MEMORY), LOST, COUNT,
                ),
                caption="CPU: writer / each reader / broker; PSS: writer / each reader",
            ),
        ),
        assessment=(assessment, faults),
        complete=complete,
        pictures=(tails("Frames between processes"), ecdf("Frames between processes")),
    ),
)  # fmt: skip
FRAMES_NULL = FRAMES.null_test(
    "One frame transport against itself, and with a fifth of its usual latency planted by the writer. The "
    "first interval must include 1.00, the second must lie above it.",
    full=Budget(130, seconds=0.4, rounds=30, size=("640x480",), readers=(1,), null=OURS),
    quick=Budget(8, rounds=2),
    variants=(),
    report={
        "assessment": (null.assessment, faults),
        "reported": ("--null", OURS),
        "pictures": (null_ratios("Null test of frames"), ecdf("Null test of frames")),
    },
)
FRAMES = replace(FRAMES, modes={"null": FRAMES_NULL})
