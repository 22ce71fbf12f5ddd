"""The judgement of a step by the trace of the motors, of robots that obey and of robots that misbehave."""

from __future__ import annotations

import math

import pytest

from pebble.extensions.lab.demo.outcome import Driven, Outcome, Wheels, outcome_of
from pebble.extensions.lab.simulation.trace import Entry

AHEAD, BACK, STOP = (0.6, 0.5), (-0.6, -0.5), (0.0, 0.0)
DRIVEN = Driven("goob", "forward, stop", AHEAD, began=100.0, released=101.2, ended=103.0)
BEFORE = ((98.0, BACK), (99.0, STOP))
Changes = tuple[tuple[float, Wheels], ...]


def judged(changes: Changes) -> Outcome:
    traced = [Entry(round(at * 1e9), "motors", f"{left:.3f} {right:.3f}") for at, (left, right) in changes]
    return outcome_of(DRIVEN, [Entry(0, "opened"), *traced])


@pytest.mark.parametrize(
    ("changes", "off_s", "wrong"),
    [
        (((100.1, AHEAD), (101.21, STOP)), 0.01, ""),
        (((100.1, BACK), (100.5, AHEAD), (101.21, STOP), (103.1, AHEAD)), 0.01, ""),
        (((100.1, AHEAD), (102.8, STOP)), 1.6, "its motors ran for 1.60 s after it was let go"),
        (((100.1, AHEAD), (103.1, STOP)), math.inf, "its motors did not stop"),
        (((100.1, (0.6, 0.0)), (101.21, STOP)), 0.01, "it did not move as commanded"),
        (((101.3, AHEAD), (101.4, STOP)), 0.2, "it did not move as commanded"),
        ((), 0.0, "it did not move as commanded"),
    ],
)
def test_a_robot_moves_while_it_is_driven_and_stands_afterwards(changes: Changes, off_s: float, wrong: str) -> None:
    for before in ((), BEFORE):
        outcome = judged((*before, *changes))
        assert (outcome.off_s, wrong in outcome.wrong, bool(outcome.wrong)) == (
            pytest.approx(off_s),
            True,
            bool(wrong),
        )
