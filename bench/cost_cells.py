"""Turns readings of robots into cells of results. Pure."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from pebble.bench.cost_robot import STREAMS, Reading
from pebble.bench.results import Cell

ALL = "all"  # the processes of a robot together
MEMORY, CPU, THREADS = "PSS", "CPU", "threads"
PICTURES, PER_PICTURE = "pictures", "CPU per picture"
_MEASURES: Sequence[tuple[str, str, Callable[[Reading], Mapping[str, float]]]] = (
    (MEMORY, "MB", lambda reading: reading.memory),
    (CPU, "%", lambda reading: reading.cpu),
    (THREADS, "", lambda reading: reading.threads),
)


def cells_of(rounds: Mapping[str, Sequence[Sequence[Reading]]]) -> list[Cell]:
    """Cells by phase, measure, kind and process; each round of a cell is one value of one robot."""
    phases = list(dict.fromkeys(reading.phase for robots in rounds.values() for robot in robots for reading in robot))
    return [
        cell
        for phase in phases
        for kind, robots in rounds.items()
        for cell in _cells(kind, phase, [reading for robot in robots for reading in robot if reading.phase == phase])
    ]


def _cells(kind: str, phase: str, readings: Sequence[Reading]) -> list[Cell]:
    cells = [
        Cell(
            variant=kind,
            params={"phase": phase, "process": process},
            measure=measure,
            unit=unit,
            rounds=[[_of(figures(reading), process)] for reading in readings],
            figures={"processes": len(readings[-1].memory)} if process == ALL else {},
        )
        for measure, unit, figures in _MEASURES
        for process in [*readings[-1].memory, ALL]
    ]
    if phase in STREAMS:
        cells += [
            _of_robot(kind, phase, PICTURES, "1/s", [[one.pictures_per_s or 0.0] for one in readings]),
            _of_robot(kind, phase, PER_PICTURE, "ms", [_per_picture_ms(one) for one in readings]),
        ]
    return cells


def _of(figures: Mapping[str, float], process: str) -> float:
    return sum(figures.values()) if process == ALL else figures.get(process, 0.0)


def _of_robot(kind: str, phase: str, measure: str, unit: str, rounds: list[list[float]]) -> Cell:
    return Cell(variant=kind, params={"phase": phase, "process": ALL}, measure=measure, unit=unit, rounds=rounds)


def _per_picture_ms(reading: Reading) -> list[float]:
    """CPU time of the whole robot for each delivered picture, including its sound."""
    rate = reading.pictures_per_s
    return [10 * _of(reading.cpu, ALL) / rate] if rate else []
