"""Turns rounds of the frames comparison into cells, tables and an assessment. Pure."""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

from rich.table import Table

from pebble.bench.frames_variants import ABOUT, VARIANTS, Case, parse_size, readers
from pebble.bench.null import variant_of
from pebble.bench.ratios import LEAST_ROUNDS, paired
from pebble.bench.results import Cell, Value, rounded
from pebble.bench.tables import figure, plain_table

MEASURE = "frame"
OURS = "zenoh-shm"


@dataclass(frozen=True, slots=True, kw_only=True)
class Round:
    """Results of one run of one case; CPU in % of one core, memory (PSS) in MB. Readers: their mean."""

    latencies_us: Sequence[float]  # of all readers
    sent: int
    torn: int
    fallbacks: int  # frames that did not go through shared memory, since the start
    cpu_writer: float
    cpu_reader: float
    cpu_broker: float | None
    memory_writer_mb: float
    memory_reader_mb: float


_MEDIANS = ("cpu_writer", "cpu_reader", "cpu_broker", "memory_writer_mb", "memory_reader_mb")
_SUMS = ("torn", "fallbacks")


def cell_of(case: Case, rounds: Sequence[Round | None]) -> Cell:
    """The cell of a case; a round of None failed. CPU and memory are medians of the rounds."""
    ran = [one for one in rounds if one is not None]
    cell = Cell(
        variant=case.name,
        params={"size": str(case.size), "readers": case.readers},
        measure=MEASURE,
        unit="us",
        rounds=[[] if one is None else list(one.latencies_us) for one in rounds],
        figures={name: _median([getattr(one, name) for one in ran]) for name in _MEDIANS},
    )
    cell.figures |= {name: sum(getattr(one, name) for one in ran) for name in _SUMS}
    if case.variant != "memcpy":  # it times copies; there is no number of sent ones
        cell.figures["sent"] = sum(one.sent for one in ran) * case.readers  # by each reader
    return cell


def assessment(cells: Sequence[Cell]) -> list[str]:
    """Compares frames without copies with each other variant, one line each: latency, and a reader's CPU."""
    lines, judged = [], all(len(cell.rounds) >= LEAST_ROUNDS for cell in cells)
    for ours in (cell for cell in cells if cell.variant == OURS):
        for theirs in cells:
            if theirs is not ours and theirs.params == ours.params:
                ratio = paired(ours.rounds, theirs.rounds)
                words = ratio.words(OURS, theirs.variant) if judged else f"{OURS} / {theirs.variant} = {ratio}"
                lines.append(f"{', '.join(_conditions(ours))}: {words}{_reader_cpu(ours, theirs)}")
    if lines and not judged:
        lines.append(f"Nothing is judged: that needs {LEAST_ROUNDS} rounds.")
    return [*lines, *failed_rounds(cells), *(line for cell in cells for line in _faults(cell))]


def complete(cells: Sequence[Cell], rounds: int) -> bool:
    """Whether every case has results, of enough of the requested ``rounds`` to judge."""
    least = LEAST_ROUNDS if rounds >= LEAST_ROUNDS else 1
    return all(sum(map(bool, cell.rounds)) >= least for cell in cells)


def failed_rounds(cells: Sequence[Cell]) -> list[str]:
    """One line for each case with failed rounds."""
    gone = {f"{', '.join(_conditions(cell))}, {cell.variant}": sum(not one for one in cell.rounds) for cell in cells}
    return [f"{where}: {count} rounds failed and are left out" for where, count in gone.items() if count]


def _faults(cell: Cell) -> list[str]:
    faults = {"torn": "frames arrived torn", "fallbacks": "frames could not go through shared memory"}
    where = f"{', '.join(_conditions(cell))}, {cell.variant}"
    return [f"{where}: {cell.figures[name]} {words}" for name, words in faults.items() if cell.figures.get(name)]


def _reader_cpu(ours: Cell, theirs: Cell) -> str:
    one, other = (cell.figures.get("cpu_reader") for cell in (ours, theirs))
    if theirs.variant == "memcpy" or not isinstance(one, (int, float)) or not isinstance(other, (int, float)):
        return ""
    return f"; CPU of a reader {figure(one)} % against {figure(other)} %"


def tables(cells: Sequence[Cell]) -> Iterator[Table]:
    """One table for each size and number of readers."""
    for _, some in groupby(sorted(cells, key=_order), key=lambda cell: _order(cell)[:2]):
        group = list(some)
        names = ("variant", "p50 µs", "p99 µs", "max µs", "CPU %", "PSS MB", "lost", "n")
        size, who = _conditions(group[0])
        shown = plain_table(f"{size} BGR at 30 Hz, {who}", names)
        for cell in group:
            shown.add_row(cell.variant, *_columns(cell))
        yield shown


def legend(variants: Sequence[str]) -> list[str]:
    return [
        *(f"{variant}: {ABOUT[variant]}" for variant in variants),
        "µs: from “frame complete in the writer” to “numpy array in the reader”.",
        "CPU %: of one core, writer / each reader / broker. PSS: writer / each reader.",
    ]


def _conditions(cell: Cell) -> tuple[str, str]:
    return str(cell.params["size"]), readers(int(cell.params["readers"] or 0))


def _order(cell: Cell) -> tuple[int, int, int]:
    size, count = parse_size(str(cell.params["size"])), int(cell.params["readers"] or 0)
    return size.bytes, count, VARIANTS.index(variant_of(cell.variant))


def _columns(cell: Cell) -> list[str]:
    times, n = [figure(cell.percentile(percent)) for percent in (50, 99, 100)], str(len(cell.samples))
    if cell.variant == "memcpy":
        return [*times, _figure(cell.figures["cpu_reader"]), "", "", n]
    broker = cell.figures["cpu_broker"]
    cpu = [cell.figures["cpu_writer"], cell.figures["cpu_reader"], *([] if broker is None else [broker])]
    memory = [cell.figures["memory_writer_mb"], cell.figures["memory_reader_mb"]]
    return [*times, " / ".join(map(_figure, cpu)), " / ".join(map(_figure, memory)), str(cell.lost), n]


def _figure(value: Value) -> str:
    return "–" if not isinstance(value, (int, float)) else f"{value:.0f}" if value >= 20 else f"{value:.1f}"


def _median(figures: Sequence[float | None]) -> float | None:
    known = [one for one in figures if one is not None]
    return rounded(statistics.median(known), 2) if known else None
