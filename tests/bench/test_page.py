"""What is said of the operator page's figures: the best try, its goal, and the others."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import cast

import pytest
from rich.console import Console

from pebble.bench import engine
from pebble.bench import page as module
from pebble.bench.page import CASES, PAGE, ROWS, PageCase, Row, goals, lost_percent
from pebble.bench.page_rig import Rig
from pebble.bench.results import Cell, Judged, load
from pebble.errors import PebbleError

KEY = Row("key to MQTT", 2, 5)
MEMORY = Row("1 viewer, driving: RSS", 60, unit="MB")


def setting() -> nullcontext[Rig]:
    return nullcontext(cast(Rig, None))


def goal_of(measure: str, *tries: list[float]) -> Judged:
    (found,) = goals([Cell(variant="page", measure=measure, unit=ROWS[measure].unit, rounds=list(tries))])
    assert isinstance(found, Judged)
    return found


def test_tries_are_compared_by_the_95th_percentile_if_it_has_a_goal() -> None:
    calm, even = [1.0] * 9 + [9.0], [3.0] * 10
    assert goal_of(KEY.key, calm, [], even).measured == "3.00 / 3.00 ms"
    assert goal_of("1 viewer, driving: CPU", even, calm).measured == "1.00 / 9.00 %"
    assert goal_of(KEY.key, [], []).measured == "– / – ms"


@pytest.mark.parametrize(
    ("measure", "samples", "expected"),
    [
        (KEY.key, [1.0, 2.0, 5.0], "met"),
        (KEY.key, [1.0, 2.0, 5.1], "missed"),
        (KEY.key, [2.1, 2.2, 2.3], "missed"),
        ("frozen to stop", [299.0], "met"),
        ("scene, json lost", [0.0], "met"),
        (KEY.key, [], "not judged"),
    ],
)
def test_a_goal_is_met_if_all_its_bounds_hold(measure: str, samples: list[float], expected: str) -> None:
    assert goal_of(measure, samples).outcome == expected


def test_goals_as_text() -> None:
    measures = (KEY.key, "frozen to stop", "1 viewer, driving: CPU")
    assert [goal_of(measure, [1.0]).what.partition(", p50 / p95 ")[2] for measure in measures] == [
        "≤ 2 / 5 ms",
        "≤ – / 300 ms",
        "≤ 8 / – %",
    ]
    cell = Cell(variant="page", measure="256 kbit/s: drive, lost", unit="%", rounds=[[93.0]])
    assert list(goals([cell])) == ["256 kbit/s: drive, lost: 93.0 / 93.0 %"], "it has none"


def test_the_best_try_is_judged_by_its_goal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tries = iter([[3.0, 6.0], [1.0, 2.0]])
    case = PageCase(lambda _rig, _scale: ((KEY.key, one) for one in next(tries)), setting, (KEY, MEMORY))
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
    def fail(_rig: Rig, _scale: float) -> Iterator[tuple[str, float]]:
        yield MEMORY.key, 1.0
        raise PebbleError("no picture")

    failing = PageCase(fail, setting, (MEMORY,))
    working = PageCase(lambda _rig, _scale: iter([(KEY.key, 1.0)]), setting, (KEY,))
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
