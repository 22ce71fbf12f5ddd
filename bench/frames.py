"""Compares ways of transferring camera frames between processes, in turn on one machine."""

from __future__ import annotations

import functools
import statistics
import subprocess
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from pebble.bench import null
from pebble.bench.comparison import Budget, Case, Comparison, Option, Run, of_known, rounds, seconds, variants
from pebble.bench.pictures import ecdf, null_ratios, tails
from pebble.bench.ratios import LEAST_ROUNDS, paired
from pebble.bench.results import Cell, Value
from pebble.bench.tables import COUNT, LOST, Column, Grid, figure, percentile_column
from pebble.bench.usage import cpu_s, pss_mb
from pebble.errors import PebbleError
from pebble.rig.broker import Broker, mosquitto_path
from pebble.rig.processes import Processes, python
from pebble.rig.programs import Worker

_ABOUT = {
    "zenoh-shm": "created in the shared segment, read as a view: no copy",
    "zenoh-copy": "shared memory, one copy in and one out",
    "zenoh-net": "Zenoh without shared memory",
    "mqtt": "mosquitto and paho, QoS 0",
    "gstreamer-shm": "shmsink and shmsrc, created in the segment, one copy out",
    "memcpy": "no transport: a bare copy of as many bytes between two frames",
}
VARIANTS = tuple(_ABOUT)
INSTALL_GSTREAMER = (
    "apt-get install -y --no-install-recommends gstreamer1.0-plugins-base gstreamer1.0-plugins-bad"
    " gir1.2-gst-plugins-base-1.0 python3-gst-1.0 python3-numpy"
)
_INSTALL_MOSQUITTO = "apt-get install -y --no-install-recommends mosquitto"
_SYSTEM_PYTHON = "/usr/bin/python3"  # the only one that Debian's gi and Gst can be imported into
_WORKER = "pebble.bench.frames_worker"
_PLAIN_WORKER = str(Path(__file__).with_name("frames_worker.py"))
_PROBE_S = 20.0
OURS = "zenoh-shm"
SIZES, READERS = ("640x480", "1920x1080"), (1, 3)
_READY_S = 20.0
_STARTUP_S = 0.1  # from the last process ready to the first counted frame
_ANSWER_S = 10.0


def parse_size(text: str) -> str:
    """``640x480``, also of ``640×480``. Raises PebbleError."""
    width, _, height = text.replace("×", "x").partition("x")
    if not (width.isdecimal() and height.isdecimal()) or not 8 <= int(width) * int(height) <= 10**8:
        raise PebbleError(f"not a size: {text} (example: 640x480)")
    if int(width) % 4:
        raise PebbleError(f"{text}: the width must be a multiple of 4, or GStreamer pads the rows")
    return f"{int(width)}x{int(height)}"


def conditions(run: Run) -> list[dict[str, Value]]:
    return [{"size": parse_size(size), "readers": count} for size in run["size"] for count in run["readers"]]


def prepare(run: Run) -> None:
    if run.comparison.is_null and "variants" in run.options:
        raise PebbleError("--null names the variant: leave --variants out")


def missing(variant: str) -> str | None:
    """Why this variant cannot run on this machine, with the command that installs it; None if it can."""
    if variant == "mqtt" and mosquitto_path() is None:
        return f"mosquitto is not installed: {_INSTALL_MOSQUITTO}"
    return _gstreamer() if variant == "gstreamer-shm" else None


@functools.cache
def _gstreamer() -> str | None:
    try:
        probe = subprocess.run([_SYSTEM_PYTHON, _PLAIN_WORKER], capture_output=True, timeout=_PROBE_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"{error}; GStreamer is read by {_SYSTEM_PYTHON}: {INSTALL_GSTREAMER}"
    return None if probe.returncode == 0 else f"GStreamer is not installed: {INSTALL_GSTREAMER}"


# -- one case


def measure(case: Case) -> Iterator[Cell]:
    """Runs one writer and its readers, each as a process. Raises PebbleError if one of them fails.

    CPU is in % of one core, memory (PSS) in MB; those of the readers are their mean.
    """
    with Processes() as processes:
        broker = processes.broker() if case.variant == "mqtt" else None
        if broker is not None:
            broker.wait()
        where, writers_first = processes.folder if broker is None else broker.port, case.variant == "gstreamer-shm"
        workers = [processes.command(f"{case}: writer", _command(case, "writer", where))]
        if writers_first:  # its readers fail without a writer; the others wait
            workers[0].answer(_READY_S)
        for number in range(int(case.condition["readers"] or 0)):
            workers.append(processes.command(f"{case}: reader {number + 1}", _command(case, "reader", where)))
        for worker in workers[writers_first:]:
            worker.answer(_READY_S)
        yield _observed(case, workers, broker, case.run["seconds"])


def _command(case: Case, role: str, where: Path | int) -> list[str]:
    """Of the writer or a reader; ``where`` is a folder for sockets, or the broker's port."""
    command = python(_WORKER) if case.variant != "gstreamer-shm" else [_SYSTEM_PYTHON, _PLAIN_WORKER]
    slower_us = case.planted_us if case.slowed else 0.0
    return [*command, *map(str, (case.variant, role, where, case.condition["size"], slower_us))]


def _observed(case: Case, workers: Sequence[Worker], broker: Broker | None, seconds: float) -> Cell:
    begin = time.monotonic_ns() + int(_STARTUP_S * 1e9)
    for worker in workers:
        worker.send(f"{begin} {begin + int(seconds * 1e9)}")
    pids = [process.pid for process in (*workers, *([] if broker is None else [broker]))]
    time.sleep(_STARTUP_S)
    before = [cpu_s([pid]) for pid in pids]
    time.sleep(seconds)
    cpu = [100 * (cpu_s([pid]) - so_far) / seconds for pid, so_far in zip(pids, before, strict=True)]
    writer, *readers = (worker.answer(_ANSWER_S) for worker in workers)
    bare = case.variant == "memcpy"  # has no writer; it times copies, so there is no number of sent ones
    copying = [sum(reader["latencies_us"]) / 1e4 / seconds for reader in readers]
    return case.cell(
        "frame",
        "us",
        (latency for reader in readers for latency in reader["latencies_us"]),
        cpu_writer=0.0 if bare else cpu[0],
        cpu_reader=statistics.fmean(copying if bare else cpu[1 : len(workers)]),
        cpu_broker=None if broker is None else cpu[-1],
        memory_writer_mb=0.0 if bare else pss_mb(workers[0].pid),
        memory_reader_mb=0.0 if bare else statistics.fmean(pss_mb(worker.pid) for worker in workers[1:]),
        torn=sum(reader["torn"] for reader in readers),
        fallbacks=writer["fallbacks"],  # frames that did not go through shared memory, since the start
        **({} if bare else {"sent": writer["sent"] * len(readers)}),  # each frame to each reader
    )


# -- the report


def assessment(cells: Sequence[Cell]) -> Iterator[str]:
    """Compares frames without copies with each other variant, one line each: latency, and a reader's CPU."""
    judged, pairs = all(len(cell.rounds) >= LEAST_ROUNDS for cell in cells), 0
    for ours in (cell for cell in cells if cell.variant == OURS):
        for theirs in (cell for cell in cells if cell is not ours and cell.params == ours.params):
            ratio, pairs = paired(ours.rounds, theirs.rounds), pairs + 1
            words = ratio.words(OURS, theirs.variant) if judged else f"{OURS} / {theirs.variant} = {ratio}"
            yield f"{_conditions(ours)}: {words}{_reader_cpu(ours, theirs)}"
    if pairs and not judged:
        yield f"Nothing is judged: that needs {LEAST_ROUNDS} rounds."


def _reader_cpu(ours: Cell, theirs: Cell) -> str:
    one, other = (cell.figures.get("cpu_reader") for cell in (ours, theirs))
    if theirs.variant == "memcpy" or not isinstance(one, (int, float)) or not isinstance(other, (int, float)):
        return ""
    return f"; CPU of a reader {figure(one)} % against {figure(other)} %"


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
    least = (LEAST_ROUNDS if len(cell.rounds) >= LEAST_ROUNDS else 1 for cell in cells)
    return all(sum(map(bool, cell.rounds)) >= enough for cell, enough in zip(cells, least, strict=True))


def legend(cells: Sequence[Cell]) -> Iterator[str]:
    measured = {null.variant_of(cell.variant) for cell in cells}
    yield from (f"{variant}: {about}" for variant, about in _ABOUT.items() if variant in measured)
    yield "µs: from “frame complete in the writer” to “numpy array in the reader”."
    yield "CPU %: of one core, writer / each reader / broker. PSS: writer / each reader."


def _conditions(cell: Cell) -> str:
    count = cell.params["readers"]
    return f"{cell.params['size']}, {'one reader' if count == 1 else f'{count} readers'}"


def _column(head: str, *names: str, bare: Sequence[str] = ()) -> Column:
    """Single values side by side; a bare copy has only the ``bare`` ones."""

    def value(cell: Cell) -> str:
        found = [cell.figures.get(name) for name in (bare if cell.variant == "memcpy" else names)]
        known = [one for one in found if isinstance(one, (int, float))]
        return " / ".join(f"{one:.0f}" if one >= 20 else f"{one:.1f}" for one in known)

    return Column(head, value)


FRAMES = Comparison(
    name="frames",
    title="Camera frames inside the robot",
    what="BGR pictures at 30 Hz from one process to others on the same machine. The latency is from the last byte "
    "written until the reader has a whole numpy array.",
    help="""Camera frames from one process to others: latency, CPU and memory.

    BGR pictures at 30 Hz through Zenoh shared memory (without copies, and with), Zenoh without shared memory, MQTT
    through mosquitto, and GStreamer's shared memory, compared with a bare copy. Each round measures every variant.

    With --null: one variant, one size (640x480), one reader, 30 rounds of 0.4 s. The run fails if it finds a
    difference where there is none, or misses the planted one.

    \b
        pebble bench frames
        pebble bench frames --size 640x480 --readers 1 --variants zenoh-shm,gstreamer-shm
        pebble bench frames --null zenoh-shm
    """,
    options=(
        seconds("Duration of each case in a round."),
        rounds("Rounds of all cases.", least=2),  # one shows no variation
        Option(name="size", many=True, metavar="SIZE", help="640x480; may be given several times."),
        Option(
            name="readers", kind=int, many=True, least=1, most=16, metavar="COUNT",
            help="May be given several times.",
        ),
        variants(VARIANTS),
        Option(
            name="null", known=VARIANTS, metavar="VARIANT", recorded=False,
            help="Only this one, against itself and against itself slowed by a fifth.",
        ),
    ),
    full=Budget(330, seconds=0.5, rounds=LEAST_ROUNDS, size=SIZES, readers=READERS, null=None),
    quick=Budget(20, rounds=2, size=SIZES[:1], readers=READERS[:1]),
    variants=VARIANTS,
    conditions=conditions,
    prepare=prepare,
    missing=missing,
    measure=measure,
    alone=True,
    measures=("frame",),
    figures={
        **dict.fromkeys(("torn", "fallbacks"), sum),
        **dict.fromkeys(
            ("cpu_writer", "cpu_reader", "cpu_broker", "memory_writer_mb", "memory_reader_mb"),
            of_known(statistics.median, 2),
        ),
    },
    tables=(
        Grid(
            title="{size} BGR at 30 Hz, readers: {readers}", each=("size", "readers"), rows=("variant",),
            columns=(
                percentile_column(50, "p50 µs"), percentile_column(99, "p99 µs"), percentile_column(100, "max µs"),
                _column("CPU %", "cpu_writer", "cpu_reader", "cpu_broker", bare=("cpu_reader",)),
                _column("PSS MB", "memory_writer_mb", "memory_reader_mb"), LOST, COUNT,
            ),
        ),
    ),
    legend=legend,
    assessment=(assessment, faults),
    complete=complete,
    summary_lines=4,
    pictures=(tails("Frames between processes"), ecdf("Frames between processes")),
)  # fmt: skip
FRAMES_NULL = replace(
    FRAMES,
    name="frames-null",
    title="Camera frames: the null test",
    what="One frame transport against itself, and with a fifth of its usual latency planted by the writer. The "
    "first interval must include 1.00, the second must lie above it.",
    full=Budget(130, seconds=0.4, rounds=30, size=SIZES[:1], readers=READERS[:1], null=OURS),
    quick=Budget(8, rounds=2),
    is_null=True,
    variants=(),
    legend=lambda _cells: (),
    assessment=(null.assessment, faults),
    words=("bench", "frames"),
    reported=("--null", OURS),
    summary_lines=0,
    pictures=(null_ratios("Null test of frames"), ecdf("Null test of frames")),
)
FRAMES = replace(FRAMES, modes={"null": FRAMES_NULL})
