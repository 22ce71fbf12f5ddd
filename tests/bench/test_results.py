"""Results are loaded as they were saved; other files are refused with one line."""

import math
import subprocess
from pathlib import Path

import pytest

from pebble.bench.engine import check_folder
from pebble.bench.results import FORMAT, Cell, Results, Stopwatch, load, machine
from pebble.errors import PebbleError


def a_cell(**more: object) -> Cell:
    values = {"variant": "mqtt", "params": {"size": "40 B", "readers": 3}, "measure": "one-way", "unit": "us"}
    return Cell(**{**values, "rounds": [[1.0, 2.0], [30.0]], **more})  # type: ignore[arg-type]


def test_a_file_comes_back_as_it_was(tmp_path: Path) -> None:
    watch = Stopwatch("control", ["pebble", "bench", "control"], {"rounds": 2, "sizes": ["40 B"]})
    results = watch.results([a_cell(figures={"sent": 4, "cpu": None})], ["equal within noise"], quick=True)
    results.save(tmp_path / "control.json")
    assert load(tmp_path / "control.json") == results


def test_all_that_repeats_it_is_there(tmp_path: Path) -> None:
    Stopwatch("control", ["pebble"], {}).results([]).save(tmp_path / "x.json")
    results = load(tmp_path / "x.json")
    assert (results.bench, results.format, results.command) == ("control", FORMAT, ["pebble"])
    assert results.pebble
    assert results.began.endswith("Z")
    assert results.machine["cpu"]
    assert results.machine["kernel"]
    assert results.machine["eclipse-zenoh"]
    assert results.machine == machine()


def test_a_broker_without_a_version_costs_no_results(monkeypatch: pytest.MonkeyPatch) -> None:
    def stuck(*_: object, **__: object) -> None:
        raise subprocess.TimeoutExpired("mosquitto", 5)

    monkeypatch.setattr(subprocess, "run", stuck)
    assert machine()["mosquitto"] is None


def test_the_machine_is_asked_before_anything_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    watch = Stopwatch("control", ["pebble"], {})
    monkeypatch.setattr("pebble.bench.results.machine", None)
    assert watch.results([]).machine["cpu"]


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
        ("[1, 2]", "holds no results"),
        ('{"bench": "control", "cells": [{"variant": "mqtt"}]}', "measure"),
        ('{"bench": "control", "cells": [{"variant": "a", "measure": "b", "unit": "s", "rounds": [["x"]]}]}', "float"),
        ('{"bench": "control", "format": 99}', "format 99"),
        ('{"rows": []}', "bench"),
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


def test_a_cell_is_found_by_what_it_is() -> None:
    cells = [a_cell(), a_cell(measure="round trip"), a_cell(params={"size": "1 KB"})]
    results = Results(bench="x", cells=cells)
    assert results.find("mqtt") is cells[0]
    assert results.find("mqtt", "round trip") is cells[1]
    assert results.find("mqtt", size="1 KB") is cells[2]
    assert results.find("zenoh") is None
    assert results.find("mqtt", readers=1) is None


def test_lost_is_what_was_sent_and_never_came() -> None:
    assert a_cell(figures={"sent": 5}).lost == 2
    assert a_cell().lost is None
    assert a_cell(figures={"sent": None}).lost is None


def test_percentiles_are_of_all_rounds() -> None:
    assert a_cell().percentile(50) == 2.0
    assert a_cell().percentile(100) == 30.0
    assert math.isnan(a_cell(rounds=[[], []]).percentile(50))


def test_conditions_are_words() -> None:
    assert a_cell().conditions() == "40 B, 3"
    assert a_cell(params={}).conditions() == ""
