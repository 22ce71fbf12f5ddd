"""What is said of the operator page's figures: the best try, its goal, and the others."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from rich.console import Console

from pebble.bench.page import CASES, Case, Goal, PagePlan, Row, Tried, cells_of, met, ranked, shown, table, words, worst
from pebble.bench.page_cases import lost_percent
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


def text(tried: Tried) -> list[str]:
    console = Console(file=io.StringIO(), width=200)
    console.print(table([tried]))
    assert isinstance(console.file, io.StringIO)
    return [" ".join(line.split()) for line in console.file.getvalue().splitlines()]


def test_the_table_shows_the_best_try_its_goal_the_prototype_and_the_others() -> None:
    case = Case("keys", lambda _rig, _scale: {}, (KEY, FRAMES))
    tried = Tried(case, tries=[{"key to MQTT": [3.0, 6.0]}, {"key to MQTT": [1.0, 2.0]}])
    lines = text(tried)
    assert "key to MQTT ms 1.00 / 2.00 2 ≤ 2 / 5 met 0.93 / 1.35 3.00 / 6.00" in lines
    assert "frames of each viewer % not measured 0 ≥ 95 each –" in lines
    (key, frames) = cells_of(tried)
    assert (key.rounds, frames.rounds) == ([[3.0, 6.0], [1.0, 2.0]], [[], []])


def test_every_row_is_named_once() -> None:
    keys = [row.key for case in CASES for row in case.rows]
    assert len(set(keys)) == len(keys)


def test_an_unknown_case_is_named(tmp_path: Path) -> None:
    with pytest.raises(PebbleError, match="no case 'keyz': choose from keys, "):
        PagePlan(only=["keyz"], output=tmp_path).check()
    assert [case.name for case in PagePlan(only=["keys"], output=tmp_path).chosen()] == ["keys"]
    assert PagePlan(only=["keys"], quick=True).command() == ["pebble", "bench", "page", "--only", "keys", "--quick"]


def test_lost_pictures_are_counted_by_their_numbers() -> None:
    assert lost_percent([7, 8, 9, 10]) == 0.0
    assert lost_percent([1, 2, 4, 5]) == pytest.approx(20.0)
    assert lost_percent([1]) == 100.0
