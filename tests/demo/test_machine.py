"""When the demo says that its machine was overloaded."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from pebble.demo.machine import Machine, Sample, overloaded

TICKS = 100  # in each slice of half a second, on two processors


def samples(*slices: tuple[int, int]) -> list[Sample]:
    """From the idle and the taken ticks of each slice."""
    result = [Sample(10.0, 5000, 300, 90_000)]
    for idle, taken in slices:
        last = result[-1]
        result.append(Sample(last.at + 0.5, last.idle + idle, last.taken + taken, last.total + TICKS))
    return result


@pytest.mark.parametrize(
    ("slices", "why"),
    [
        ([(50, 0), (30, 5), (20, 0)], ""),
        ([(50, 0), (40, 35), (50, 0)], "35% of the processors were taken by other guests, 40% were idle"),
        ([(50, 0), (2, 0), (50, 0)], "0% of the processors were taken by other guests, 2% were idle"),
        ([(0, 60)], "60% of the processors were taken by other guests, 0% were idle"),
        ([], ""),
    ],
)
def test_the_worst_slice_decides(slices: list[tuple[int, int]], why: str) -> None:
    assert overloaded(samples(*slices), 10.0, 20.0) == why


@pytest.mark.parametrize(("began", "ended", "counts"), [(10.0, 10.4, False), (10.6, 10.7, True), (11.1, 12.0, False)])
def test_only_slices_of_that_time_count(began: float, ended: float, counts: bool) -> None:
    assert bool(overloaded(samples((50, 0), (0, 0), (50, 0)), began, ended)) is counts


def test_of_a_rate_the_whole_time_decides() -> None:
    assert overloaded(samples((50, 0), (0, 0), (50, 0)), 10.0, 20.0, on_average=True) == ""
    assert "0% were idle" in overloaded(samples((0, 0), (0, 0), (1, 0)), 10.0, 20.0, on_average=True)


def test_this_machine_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    machine, before = Machine(), time.monotonic()
    machine.sample()
    time.sleep(0.5)
    monkeypatch.setattr("pebble.demo.machine._LEAST_IDLE", 1.01)  # nothing can be that idle
    assert "idle" in machine.overloaded(before, time.monotonic())


def test_where_the_system_does_not_count_nothing_is_excused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("pebble.demo.machine._STAT", tmp_path / "none")
    machine = Machine()
    machine.sample()
    assert machine.overloaded(0.0, time.monotonic()) == ""
