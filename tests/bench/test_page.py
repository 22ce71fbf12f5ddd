"""What is said of the operator page's figures: the best try, its goal, and the others."""

from __future__ import annotations

import io
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import cast

import pytest
from rich.console import Console

from pebble.bench import engine
from pebble.bench import page as module
from pebble.bench.page import CASES, PAGE, Goal, PageCase, Row, met, ranked, shown, words, worst
from pebble.bench.page_cases import lost_percent
from pebble.bench.page_rig import Rig
from pebble.bench.results import load
from pebble.errors import PebbleError

KEY = Row("key to MQTT", "ms", Goal(2, 5), "0.93 / 1.35")
FRAMES = Row("frames of each viewer", "%", Goal(at_least=95))


def test_tries_are_compared_by_the_95th_percentile_if_it_has_a_goal() -> None:
    calm, even = [1.0] * 9 + [9.0], [3.0] * 10
    assert worst(KEY, calm) == 9.0
    assert ranked(KEY, [calm, [], even]) == [even, calm]
    assert ranked(Row("CPU", "%", Goal(8)), [even, calm]) == [calm, even]


def test_of_viewers_the_worst_one_counts() -> None:
    assert ranked(FRAMES, [[99.0, 90.0], [96.0, 96.0]])[0] == [96.0, 96.0]
    assert met(FRAMES.goal, [96.0, 95.0])
    assert met(FRAMES.goal, [100.0, 94.0]) is False
    assert shown(FRAMES.goal, [100.0, 94.0]) == "94.0 / 100, least 94.0"


@pytest.mark.parametrize(
    ("goal", "samples", "expected"),
    [
        (Goal(2, 5), [1.0, 2.0, 5.0], True),
        (Goal(2, 5), [1.0, 2.0, 5.1], False),
        (Goal(2, 5), [2.1, 2.2, 2.3], False),
        (Goal(None, 300), [299.0], True),
        (Goal(0, 0), [0.0], True),
        (Goal(), [1.0], None),
    ],
)
def test_a_goal_is_met_if_all_its_bounds_hold(goal: Goal, samples: list[float], expected: bool | None) -> None:
    assert met(goal, samples) is expected


def test_goals_and_figures_as_text() -> None:
    assert [words(goal) for goal in (Goal(2, 5), Goal(None, 300), Goal(8), Goal(at_least=95), Goal())] == [
        "≤ 2 / 5",
        "≤ – / 300",
        "≤ 8 / –",
        "≥ 95 each",
        "–",
    ]
    assert shown(Goal(2, 5), [1.0, 2.0, 30.0]) == "2.00 / 30.0"
    assert shown(Goal(8), [4.2]) == "4.20"


def test_the_table_shows_the_best_try_its_goal_the_prototype_and_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tries = iter([{"key to MQTT": [3.0, 6.0]}, {"key to MQTT": [1.0, 2.0]}])
    case = PageCase("keys", lambda _rig, _scale: next(tries), (KEY, FRAMES), lambda: nullcontext(cast(Rig, None)))
    monkeypatch.setattr(module, "CASES", (case,))
    console = Console(file=io.StringIO(), width=200)
    assert engine.run(PAGE.run_of(rounds=2, output=tmp_path, console=console)) == 0
    assert isinstance(console.file, io.StringIO)
    lines = [" ".join(line.split()) for line in console.file.getvalue().splitlines()]
    assert "key to MQTT ms 1.00 / 2.00 2 ≤ 2 / 5 met 0.93 / 1.35 3.00 / 6.00" in lines
    assert "frames of each viewer % not measured 0 ≥ 95 each 50" in lines
    results = load(tmp_path / "page.json")
    assert [cell.rounds for cell in results.cells] == [[[3.0, 6.0], [1.0, 2.0]], [[], []]]
    assert [aim.outcome for aim in results.aims] == ["met", "not judged"]
    assert results.assessment[1].startswith("keys, try 2: load ")


def test_a_case_that_fails_is_noted_and_costs_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_rig: Rig, _scale: float) -> dict[str, list[float]]:
        raise PebbleError("no picture")

    failing = PageCase("pictures", fail, (FRAMES,), lambda: nullcontext(cast(Rig, None)))
    working = replace(failing, name="keys", measure=lambda _rig, _scale: {KEY.key: [1.0]}, rows=(KEY,))
    monkeypatch.setattr(module, "CASES", (failing, working))
    console = Console(file=io.StringIO(), width=200)
    assert engine.run(PAGE.run_of(quick=True, output=tmp_path, console=console)) == 1
    results = load(tmp_path / "page.json")
    assert [cell.samples for cell in results.cells] == [[], [1.0]]
    assert "pictures, try 1: no picture" in results.assessment


def test_every_row_is_named_once() -> None:
    keys = [row.key for case in CASES for row in case.rows]
    assert len(set(keys)) == len(keys)


def test_an_unknown_case_is_named() -> None:
    with pytest.raises(PebbleError, match="--only: unknown keyz: there are keys, "):
        PAGE.run_of(cases=["keyz"])
    run = PAGE.run_of(cases=["keys"], quick=True)
    assert PAGE.conditions(run) == [{"case": "keys"}]
    assert " ".join(run.command) == "pebble bench page --only keys --tries 1 --wait 0 --quick"


def test_lost_pictures_are_counted_by_their_numbers() -> None:
    assert lost_percent([7, 8, 9, 10]) == 0.0
    assert lost_percent([1, 2, 4, 5]) == pytest.approx(20.0)
    assert lost_percent([1]) == 100.0
