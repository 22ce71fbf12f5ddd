"""A few of the random sequences in Chromium; ``python -m tests.web.chromium_schedules`` runs hundreds."""

from __future__ import annotations

import pytest

from tests.web.chromium_schedules.__main__ import perform
from tests.web.chromium_schedules.rules import BUSY_S, Motors, Press, problems
from tests.web.chromium_schedules.schedules import make

pytestmark = pytest.mark.page  # deadlines are checked

FORWARD, TURN, REST = (0.6, 0.6), (0.558, -0.6), (0.0, 0.0)


@pytest.mark.parametrize(("robot", "seed"), [("minilamp", 26), ("minilamp", 28), ("fred", 9)])
def test_no_wheel_turns_outside_a_living_gesture(robot: str, seed: int) -> None:
    ((_, found, log),) = perform(robot, [seed])
    assert not found, (found, log)


@pytest.mark.parametrize(
    ("axes", "until", "motors", "forbidden"),
    [
        ([], 0.0, [(1.0, FORWARD), (2.0, REST)], True),
        ([(0, 1)], float("inf"), [(1.0, FORWARD), (9.0, REST)], False),
        ([(0, 1)], 3.0, [(1.0, FORWARD), (2.9, REST)], False),
        ([(0, 1)], 3.0, [(1.0, FORWARD), (3.1, REST)], True),
        ([(0, 1)], 3.0, [(1.0, FORWARD), (2.0, REST), (4.0, FORWARD), (4.1, REST)], True),
        ([(0, -1)], 9.0, [(1.0, FORWARD), (2.0, REST)], True),
        ([(0, 1), (1, 0)], 9.0, [(1.0, TURN), (2.0, (0.558, 0.0)), (3.0, FORWARD), (4.0, REST)], False),
        ([(0, 1)], 9.0, [(1.0, TURN), (2.0, REST)], True),
        ([(0, 1)], 9.0, [(0.2, FORWARD), (0.3, REST)], True),
    ],
)
def test_rules_find_what_they_forbid(
    axes: list[tuple[int, int]], until: float, motors: Motors, forbidden: bool
) -> None:
    presses = [Press(1, "key", one, 0.5, until) for one in axes]
    assert bool(list(problems(presses, motors, 20.0))) == forbidden


def test_an_input_ends_at_its_first_end() -> None:
    press = Press(1, "KeyW", (0, 1), 0.0)
    press.end(2.0, 0.5, "the later one")
    press.end(1.0, 0.5, "the earlier one")
    press.end(3.0, 0.1, "another")
    assert (press.until, press.why) == (1.5 + BUSY_S, "the earlier one")


def test_a_seed_makes_one_schedule() -> None:
    assert make(7) == make(7)
    assert make(7).steps != make(9).steps
