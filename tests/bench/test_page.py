"""What is said of the operator page's figures: the best try, its goal, and the others."""

from __future__ import annotations

import io
from contextlib import nullcontext
from pathlib import Path
from typing import cast

import pytest
from rich.console import Console

from pebble.bench import engine
from pebble.bench import page as module
from pebble.bench.page import CASES, PAGE, PageCase, Row, lost_percent
from pebble.bench.page_rig import Rig
from pebble.bench.results import load
from pebble.errors import PebbleError

KEY = Row("key to MQTT", 2, 5)
MEMORY = Row("1 viewer, driving: RSS", 60, unit="MB")


def test_tries_are_compared_by_the_95th_percentile_if_it_has_a_goal() -> None:
    calm, even = [1.0] * 9 + [9.0], [3.0] * 10
    assert KEY.best([calm, [], even]) == even
    assert Row("CPU", 8, unit="%").best([even, calm]) == calm
    assert KEY.best([[], []]) == []


@pytest.mark.parametrize(
    ("row", "samples", "expected"),
    [
        (Row("a", 2, 5), [1.0, 2.0, 5.0], True),
        (Row("a", 2, 5), [1.0, 2.0, 5.1], False),
        (Row("a", 2, 5), [2.1, 2.2, 2.3], False),
        (Row("a", p95=300), [299.0], True),
        (Row("a", 0, 0), [0.0], True),
        (Row("a", 2, 5), [], False),
    ],
)
def test_a_goal_is_met_if_all_its_bounds_hold(row: Row, samples: list[float], expected: bool) -> None:
    assert row.met(samples) is expected


def test_goals_as_text() -> None:
    assert [row.goal for row in (KEY, Row("a", p95=300), Row("a", 8), Row("a"))] == [
        "≤ 2 / 5",
        "≤ – / 300",
        "≤ 8 / –",
        "",
    ]


def test_the_best_try_is_judged_by_its_goal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tries = iter([{"key to MQTT": [3.0, 6.0]}, {"key to MQTT": [1.0, 2.0]}])
    case = PageCase(lambda _rig, _scale: next(tries), (KEY, MEMORY), lambda: nullcontext(cast(Rig, None)))
    monkeypatch.setattr(module, "CASES", {"keys": case})
    console = Console(file=io.StringIO(), width=200)
    assert engine.run(PAGE.run_of(rounds=2, output=tmp_path, console=console)) == 1, "something was not measured"
    assert isinstance(console.file, io.StringIO)
    results = load(tmp_path / "page.json")
    assert [cell.rounds for cell in results.cells] == [[[3.0, 6.0], [1.0, 2.0]], [[], []]]
    assert str(results.aims[0]) == "aim: key to MQTT, p50 / p95 ≤ 2 / 5 ms: met (1.00 / 2.00 ms)"
    assert [aim.outcome for aim in results.aims] == ["met", "not judged"]
    assert all(str(aim) in console.file.getvalue() for aim in results.aims)
    assert results.assessment[1].startswith("keys, try 2: load ")


def test_a_case_that_fails_is_noted_and_costs_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_rig: Rig, _scale: float) -> dict[str, list[float]]:
        raise PebbleError("no picture")

    failing = PageCase(fail, (MEMORY,), lambda: nullcontext(cast(Rig, None)))
    working = failing._replace(measure=lambda _rig, _scale: {KEY.key: [1.0]}, rows=(KEY,))
    monkeypatch.setattr(module, "CASES", {"pictures": failing, "keys": working})
    console = Console(file=io.StringIO(), width=200)
    assert engine.run(PAGE.run_of(quick=True, output=tmp_path, console=console)) == 1
    results = load(tmp_path / "page.json")
    assert [cell.samples for cell in results.cells] == [[], [1.0]]
    assert "pictures, try 1: no picture" in results.assessment


def test_every_row_is_named_once() -> None:
    keys = [row.key for case in CASES.values() for row in case.rows]
    assert len(set(keys)) == len(keys)


def test_an_unknown_case_is_named() -> None:
    with pytest.raises(PebbleError, match="--only: unknown keyz: there are keys, "):
        PAGE.run_of(cases=["keyz"])
    run = PAGE.run_of(cases=["keys"], quick=True)
    assert PAGE.conditions(run) == [{"case": "keys"}]
    assert " ".join(run.command) == "pebble bench page --only keys --rounds 1 --quick"


def test_lost_pictures_are_counted_by_their_numbers() -> None:
    assert lost_percent([7, 8, 9, 10]) == 0.0
    assert lost_percent([1, 2, 4, 5]) == pytest.approx(20.0)
    assert lost_percent([1]) == 100.0
