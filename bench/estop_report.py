"""Samples, the table and the assessment of the comparison of emergency stops. Pure but for the printing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table

from pebble.bench.percentiles import percentile
from pebble.bench.results import Cell
from pebble.bench.robot_comparison import caveat, sentence
from pebble.bench.tables import base_of, figure

REST, CONFIRMED = "wheels at rest", "confirmed"
HOLD, WIRE = "latched under a hold", "first stop sent"
ESTOP, COMMAND, ZERO = "emergency stop", "pebble estop", "plain zero"
ALL, BOARD = "all together", "board"

_PERCENT = 95
LEAST_SAMPLES = 10  # to assess an aim
AIMS_MS = {REST: 50.0, CONFIRMED: 500.0, HOLD: 1000.0}
_REST_ALL_MS = 250.0

_Key = tuple[str, str, str]


@dataclass(frozen=True, slots=True)
class Sample:
    """One time; ``robot`` is the transport of a Linux robot, BOARD or ALL. ``ms`` None: it did not happen."""

    measure: str
    robot: str
    variant: str
    ms: float | None
    again: bool = False  # wheels turned again while the robot was stopped


class Samples:
    """All samples of a round, in the order they were taken."""

    def __init__(self) -> None:
        self.all: list[Sample] = []

    def add(
        self, measure: str, robot: str, variant: str, began: int, ended: int | None, *, again: bool = False
    ) -> None:
        """``began`` and ``ended`` are CLOCK_MONOTONIC, ns."""
        ms = None if ended is None else (ended - began) / 1e6
        self.all.append(Sample(measure, robot, variant, ms, again))


def cells_of(rounds: Sequence[Sequence[Sample]]) -> list[Cell]:
    """One cell for each measure, robot and variant, in the order of their first samples."""
    keys = dict.fromkeys(_key(sample) for samples in rounds for sample in samples)
    order = (REST, CONFIRMED, HOLD, WIRE)
    return [_cell(key, rounds) for key in sorted(keys, key=lambda key: order.index(key[0]))]


def _cell(key: _Key, rounds: Sequence[Sequence[Sample]]) -> Cell:
    measure, robot, variant = key
    own = [[sample for sample in samples if _key(sample) == key] for samples in rounds]
    again = sum(sample.again for samples in own for sample in samples)
    return Cell(
        variant=variant,
        params={"robot": robot},
        measure=measure,
        unit="ms",
        rounds=[[sample.ms for sample in samples if sample.ms is not None] for samples in own],
        figures={"sent": sum(map(len, own)), "again": again},
    )


def _key(sample: Sample) -> _Key:
    return sample.measure, sample.robot, sample.variant


def show(cells: Sequence[Cell], console: Console) -> None:
    """Milliseconds; the ratios to a plain zero are sentences below, so that the table fits into a narrow terminal."""
    table = Table(title="From the stop, while driving goes on; ms", title_justify="left", box=SIMPLE)
    for name in ("", "by", "n", "p50", "p95", "most"):
        table.add_column(name, justify="left" if name in ("", "by") else "right")
    for cell in cells:
        times = [figure(cell.percentile(percent)) for percent in (50, _PERCENT, 100)] if cell.samples else ["none"] * 3
        table.add_row(f"{cell.measure}, {cell.conditions()}", cell.variant, str(len(cell.samples)), *times)
    console.print(table)


def assessment(cells: Sequence[Cell]) -> list[str]:
    """One sentence for each comparison with a plain zero, and one for each aim."""
    pairs = [(base, cell) for cell in cells if (base := base_of(cell, cells, ZERO)) is not None and base is not cell]
    plain = [pair for pair in pairs if pair[1].variant == ESTOP]
    lines = [
        sentence(f"{cell.measure}, {cell.conditions()}", pair, quantity="time") for pair in plain for cell in pair[1:]
    ]
    notes = caveat(plain[0]) if plain else []
    aims = [line for cell in cells for line in _aim(cell)]
    return [*lines, *notes, *_command(cells), *aims, *_again(cells)]


def _command(cells: Sequence[Cell]) -> list[str]:
    """The time that a person who enters the command waits."""
    return [
        f"{cell.conditions()}: pebble estop sends its first stop {figure(cell.percentile(50))} ms (p50) after it is"
        f" entered, {figure(cell.percentile(100))} ms at most"
        for cell in cells
        if cell.measure == WIRE
    ]


def _aim(cell: Cell) -> list[str]:
    if cell.variant != ESTOP or cell.measure not in AIMS_MS:
        return []
    robot = cell.params["robot"]
    aim = _REST_ALL_MS if (cell.measure, robot) == (REST, ALL) else AIMS_MS[cell.measure]
    times = [*cell.samples, *[math.inf] * (cell.lost or 0)]
    took = percentile(times, _PERCENT)
    outcome = "not judged" if len(times) < LEAST_SAMPLES else "met" if took <= aim else "missed"
    took_text = "not at all" if math.isinf(took) else f"{figure(took)} ms"
    return [f"aim: {robot}, {cell.measure}, p{_PERCENT} at most {aim:g} ms: {outcome} ({took_text})"]


def _again(cells: Sequence[Cell]) -> list[str]:
    """Whether wheels turned after an emergency stop, though drive commands went on."""
    stops = [cell for cell in cells if cell.measure == REST and cell.variant != ZERO]
    sent, again = (sum(int(cell.figures[name] or 0) for cell in stops) for name in ("sent", "again"))
    outcome = "missed" if again else "met"
    return [f"aim: wheels stay at rest after a stop while driving goes on: {outcome} ({again} of {sent} turned again)"]
