"""A few of the random schedules of scripts and faults; ``python -m tests.robot.script_schedules`` runs hundreds."""

from __future__ import annotations

from typing import Any

import pytest

from tests.robot.script_schedules.__main__ import perform
from tests.robot.script_schedules.rules import Lines, problems
from tests.robot.script_schedules.schedules import make
from tests.robot.stop_schedules.history import History
from tests.support import further

pytestmark = pytest.mark.alone  # deadlines are checked


@pytest.mark.parametrize(("transport", "seed"), [("mqtt", 4), further("zenoh", 2)])
def test_a_persons_stop_and_the_end_of_a_script_are_seen_at_the_wheels(transport: str, seed: int) -> None:
    ((_, found, log),) = perform(transport, [seed])
    assert not found, log


FORWARD, BACK, REST = (0.5, 0.5), (-0.3, -0.3), (0.0, 0.0)
FINAL = [("zero", {"final": True})]


@pytest.mark.parametrize(
    ("events", "lines", "overlaps", "problem"),
    [
        ([], [(1.0, BACK), (1.1, REST)], [], ""),
        ([], [(1.0, BACK), (2.4, REST)], [], "turn for"),
        ([], [(1.0, FORWARD), (1.5, REST), (1.6, BACK), (1.7, REST)], [], "after a person"),
        ([], [(1.0, FORWARD), (1.5, REST), (3.1, BACK), (3.2, REST)], [], ""),
        (FINAL, [(1.0, BACK), (1.1, REST)], [], "after zero"),
        ([("zero", {"final": False})], [(1.0, BACK), (1.1, REST)], [], ""),
        ([("estop", {})], [(1.0, BACK), (1.1, REST)], [], "after estop"),
        ([("manager killed", {})], [(1.0, BACK), (1.1, REST)], [], ""),
        ([("manager killed", {})], [(1.3, BACK), (1.4, REST)], [], "after manager killed"),
        ([], [], [(1.0, [7, 8])], "two scripts"),
    ],
)
def test_rules_find_what_they_forbid(
    events: list[tuple[str, dict[str, Any]]], lines: Lines, overlaps: list[tuple[float, list[int]]], problem: str
) -> None:
    history = History()
    for what, details in events:
        history.add(what, at=0.0, **details)
    found = problems(history, lines, lines, overlaps)
    assert [problem in one for one in found] == [True] * bool(problem), found


def test_what_the_machine_held_up_is_allowed_as_much_longer() -> None:
    """Several lines that are read at once prove nothing of it: their writer may have slept as well."""
    for lines in ([(1.0, BACK), (2.1, REST)], [(1.0, BACK), (2.1, BACK), (2.1, REST)]):
        for stalls, allowed in (([], False), ([(1.8, 2.1)], True), ([(1.2, 1.3), (1.25, 1.35)], False)):
            assert (problems(History(), lines, lines, [], stalls) == []) is allowed


def test_a_seed_makes_one_schedule() -> None:
    assert make("mqtt", 7) == make("mqtt", 7)
    assert make("mqtt", 7) != make("mqtt", 8)
    assert make("mqtt", 7) != make("zenoh", 7)
