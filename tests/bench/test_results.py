"""Results are loaded as they were saved; other files are refused with one line."""

import math
import random
from pathlib import Path

import pytest

from pebble.bench.engine import check_folder
from pebble.bench.judging.compare import compare
from pebble.bench.results import FORMAT, OVER_TIME, Cell, Results, begin, load, machine, pack, percentile
from pebble.errors import PebbleError


def a_cell(**more: object) -> Cell:
    values = {"variant": "mqtt", "params": {"size": "40 B", "readers": 3}, "measure": "one-way", "unit": "us"}
    return Cell(**{**values, "rounds": [[1.0, 2.0], [30.0]], **more})  # type: ignore[arg-type]


def test_a_file_comes_back_as_it_was(tmp_path: Path) -> None:
    results = begin("control", ["pebble", "bench", "control"], quick=True)
    results.options, results.assessment = {"rounds": 2, "sizes": ["40 B"]}, ["equal within noise"]
    results.cells = [a_cell(figures={"sent": 4, "cpu": None})]
    results.save(tmp_path / "control.json")
    assert load(tmp_path / "control.json") == results


def test_all_that_repeats_it_is_there(tmp_path: Path) -> None:
    begin("control", ["pebble"]).save(tmp_path / "x.json")
    results = load(tmp_path / "x.json")
    assert (results.bench, results.format, results.command) == ("control", FORMAT, ["pebble"])
    assert results.pebble
    assert results.began.endswith("Z")
    assert results.machine["cpu"]
    assert results.machine["kernel"]
    assert results.machine["eclipse-zenoh"]
    assert results.machine == machine()


def test_a_machine_without_a_broker_is_described_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pebble.rig.processes.mosquitto_path", lambda: None)
    assert machine()["mosquitto"] is None


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


def test_lost_is_what_was_sent_and_never_came() -> None:
    assert a_cell(figures={"sent": 5}).lost == 2
    assert a_cell().lost is None
    assert a_cell(figures={"sent": None}).lost is None


def test_percentiles_are_of_all_rounds() -> None:
    assert a_cell().percentile(50) == 2.0
    assert a_cell().percentile(100) == 30.0
    assert math.isnan(a_cell(rounds=[[], []]).percentile(50))


def test_conditions_are_words() -> None:
    assert a_cell().conditions() == "40 B, readers: 3"
    assert a_cell(params={"load": None, "rate": 10.0}).conditions() == "rate: 10.0"
    assert a_cell(params={}).conditions() == ""


# -- thinned


def test_percentiles_of_a_thinned_round_are_those_of_all_samples(tmp_path: Path) -> None:
    noise = random.Random(1)
    rounds = [[round(noise.lognormvariate(5, 1), 3) for _ in range(count)] for count in (5000, 777, 30, 0)]
    whole = a_cell(rounds=rounds, figures={"sent": 6000})
    (tmp_path / "foreign.json").write_text("[]")
    Results(bench="control", cells=[whole]).save(tmp_path / "control.json")
    pack(tmp_path)
    assert (tmp_path / "control.json").stat().st_size + (tmp_path / "samples.json.xz").stat().st_size < 6000
    (cell,) = load(tmp_path / "control.json").cells
    for percent in (50, 95, 99, 100):
        assert [percentile(one, percent) for one in cell.rounds[:3]] == [percentile(one, percent) for one in rounds[:3]]
        assert cell.percentile(percent) == whole.percentile(percent)
    assert (cell.lost, cell.sizes) == (whole.lost, [5000, 777, 30, 0])
    assert len(cell.samples) <= 2000
    assert cell.rounds[2] == sorted(rounds[2])
    before = load(tmp_path / "control.json")
    pack(tmp_path)  # after the next report
    assert load(tmp_path / "control.json") == before


def test_a_curve_keeps_its_order(tmp_path: Path) -> None:
    cell = a_cell(
        measure=f"audio{OVER_TIME}", rounds=[[float(n) for n in range(3000)], [float(-n) for n in range(3000)]]
    )
    seconds, values = cell.thinned().rounds
    assert values == [-one for one in seconds]
    assert len(seconds) == 1000


def test_two_thinned_runs_are_compared_as_the_whole_ones(tmp_path: Path) -> None:
    noise = random.Random(2)
    whole = [
        Results(
            bench="x", cells=[a_cell(rounds=[[factor * noise.gauss(100, 5) for _ in range(400)] for _ in range(9)])]
        )
        for factor in (1.0, 1.3)
    ]
    thinned = [Results(bench="x", cells=[cell.thinned() for cell in one.cells]) for one in whole]
    assert [(f.kind, f.percent) for f in compare(*thinned)] == [(f.kind, f.percent) for f in compare(*whole)]


def test_samples_that_are_missing_are_named(tmp_path: Path) -> None:
    Results(bench="control", cells=[a_cell()]).save(tmp_path / "control.json")
    pack(tmp_path)
    (tmp_path / "samples.json.xz").unlink()
    with pytest.raises(PebbleError, match=r"samples\.json\.xz does not hold the samples of control"):
        load(tmp_path / "control.json")
