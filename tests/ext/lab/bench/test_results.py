"""Results are loaded as they were saved; other files are refused with one line."""

import math
from dataclasses import dataclass
from pathlib import Path

import pytest

from pebble.errors import PebbleError
from pebble.extensions.lab.bench import plots
from pebble.extensions.lab.bench.results import Cell, begin, load, machine, percentile


@dataclass
class Settings:
    """What is measured."""

    rounds: int = 2
    sizes: tuple[str, ...] = ("40 B",)


def a_cell(**more: object) -> Cell:
    values = {"variant": "mqtt", "params": {"size": "40 B", "readers": 3}, "measure": "one-way", "unit": "us"}
    return Cell(**{**values, "rounds": [[1.0, 2.0], [30.0]], **more})  # type: ignore[arg-type]


def test_a_file_comes_back_as_it_was_with_all_that_repeats_it(tmp_path: Path) -> None:
    results = begin("control", Settings())
    results.notes, results.cells = ["left out"], [a_cell(rounds=[[1.23456]], figures={"sent": [4], "cpu": [1.5]})]
    results.save(tmp_path / "control.json")
    loaded = load(tmp_path / "control.json")
    assert loaded.options == {"rounds": 2, "sizes": ["40 B"]}
    assert (loaded.bench, loaded.notes) == ("control", ["left out"])
    assert loaded.cells == [a_cell(rounds=[[1.235]], figures={"sent": [4], "cpu": [1.5]})], "three digits are kept"
    assert loaded.began.endswith("Z")
    assert loaded.machine == machine()
    assert all(loaded.machine[name] for name in ("cpu", "kernel", "eclipse-zenoh"))


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", "holds no results"),
        ("{}", "bench"),
        ('{"bench": "control", "cells": [{"variant": "mqtt"}]}', "measure"),
        ("\xff\xfe", "holds no results"),
    ],
)
def test_what_is_no_file_of_results_is_named(tmp_path: Path, text: str, named: str) -> None:
    file = tmp_path / "x.json"
    file.write_text(text, encoding="latin-1")
    with pytest.raises(PebbleError, match=named) as error:
        load(file)
    assert str(file) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("figures", "percent", "expected"),
    [([3.0, 1.0, 2.0], 50, 2.0), ([1.0, 2.0], 50, 1.0), (list(range(1, 101)), 99, 99), ([], 50, math.nan)],
)
def test_a_percentile_is_a_figure_that_was_measured(figures: list[float], percent: float, expected: float) -> None:
    assert percentile(figures, percent) == pytest.approx(expected, nan_ok=True)


def test_the_curve_of_a_picture_ends_below_100_percent_by_what_was_lost() -> None:
    for sent, top in ((90, 100), (100, 90)):
        (picture,) = plots.curves("x", "X", [a_cell(rounds=[[1.0] * 90], figures={"sent": [sent]})])
        (curve, *_) = picture.make().axes[0].get_lines()
        assert max(curve.get_ydata()) == pytest.approx(top)  # type: ignore[arg-type]
