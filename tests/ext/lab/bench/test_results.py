"""Results are loaded as they were saved; other files are refused with one line."""

import math
from dataclasses import dataclass
from pathlib import Path

import pytest

from pebble.errors import PebbleError
from pebble.extensions.lab.bench.results import FORMAT, Cell, Results, begin, check_folder, load, machine, percentile


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
    results.notes, results.cells = ["left out"], [a_cell(figures={"sent": [4], "cpu": [1.5]})]
    results.save(tmp_path / "control.json")
    loaded = load(tmp_path / "control.json")
    assert loaded.options == {"rounds": 2, "sizes": ["40 B"]}
    assert (loaded.bench, loaded.format, loaded.cells, loaded.notes) == ("control", FORMAT, results.cells, ["left out"])
    assert loaded.began.endswith("Z")
    assert loaded.machine == machine()
    assert all(loaded.machine[name] for name in ("cpu", "kernel", "eclipse-zenoh"))


def test_a_folder_in_which_nothing_can_be_written_is_refused(tmp_path: Path) -> None:
    check_folder(tmp_path / "new")
    assert list((tmp_path / "new").iterdir()) == []
    with pytest.raises(PebbleError, match="/proc: "):
        check_folder(Path("/proc"))  # it exists, and not even root can write into it


def test_samples_keep_three_digits(tmp_path: Path) -> None:
    Results(bench="x", cells=[a_cell(rounds=[[1.23456]])]).save(tmp_path / "x.json")
    assert load(tmp_path / "x.json").cells[0].rounds == [[1.235]]


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", "holds no results"),
        ("{}", "bench"),
        ('{"bench": "control", "cells": [{"variant": "mqtt"}]}', "measure"),
        ('{"bench": "control", "format": 1}', "has format 1, this pebble reads 2: measure again"),
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


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(PebbleError, match=r"no\.json: No such file"):
        load(tmp_path / "no.json")
    with pytest.raises(PebbleError, match="Not a directory"):
        Results(bench="x").save(Path("/dev/null/x.json"))


def test_lost_is_what_was_sent_and_never_came() -> None:
    cell = a_cell(figures={"sent": [3, 2]})
    assert cell.lost == 2
    assert cell.with_lost() == [[1.0, 2.0, math.inf], [30.0, math.inf]]
    assert a_cell().lost is None
    assert a_cell().with_lost() == a_cell().rounds


@pytest.mark.parametrize(
    ("figures", "percent", "expected"),
    [([5.0], 50, 5.0), ([3.0, 1.0, 2.0], 50, 2.0), ([1.0, 2.0], 50, 1.0), (list(range(1, 101)), 99, 99),
     ([1.0, 9.0], 0, 1.0)],
)  # fmt: skip
def test_a_percentile_is_a_figure_that_was_measured(figures: list[float], percent: float, expected: float) -> None:
    assert percentile(figures, percent) == expected


def test_nothing_has_no_percentile() -> None:
    assert math.isnan(percentile([], 50))


def test_a_cell_is_found_by_what_it_measured() -> None:
    results = Results(bench="x", cells=[a_cell(), a_cell(variant="zenoh", params={"size": "1 KB"})])
    assert results.find("mqtt", "one-way", readers=3) is results.cells[0]
    assert results.find("zenoh", "one-way", size="40 B") is None
