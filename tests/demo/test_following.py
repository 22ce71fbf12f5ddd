"""The judgement of a robot that follows a tag, by drive lines and the true outcome."""

from __future__ import annotations

from dataclasses import replace

import pytest

from pebble.demo.following import FollowResult, Outcome, assess
from pebble.demo.operator import DISTANCE_M, CompletedFollow
from pebble.simulation.trace import Entry

STARTED, TOOK_OVER, RELEASED, ENDED = 100.0, 104.0, 105.0, 112.0
PERSON, AHEAD, STOP = (-0.5, -0.4), (0.4, 0.5), (0.0, 0.0)
COMPLETED = CompletedFollow("goob", STARTED, TOOK_OVER, PERSON, RELEASED, ENDED, "horn.wav")
ARRIVED = Outcome(DISTANCE_M + 0.01, 0.02, 1.0, 1.0)
Lines = tuple[tuple[float, tuple[float, float]], ...]
BEFORE: Lines = ((101.5, AHEAD), (103.99, AHEAD))
OVERRIDE: Lines = ((104.004, PERSON), (104.9, PERSON), (105.003, STOP))
AFTER: Lines = ((107.05, AHEAD), (111.0, STOP))


def judged(*lines: tuple[float, tuple[float, float]], outcome: Outcome = ARRIVED) -> FollowResult:
    entries = [Entry(round(at * 1e9), "line", f"M {left:.3f} {right:.3f}") for at, (left, right) in lines]
    return assess(COMPLETED, [Entry(0, "opened"), *entries], outcome)


def test_a_robot_that_follows_obeys_and_resumes() -> None:
    result = judged(*BEFORE, *OVERRIDE, *AFTER)
    assert result.wrong == ()
    assert [check.measured for check in result.checks] == [
        *("1.50 s after its start", "first line after 4 ms", "0 of 3"),
        *("2.05 s after the operator let go", "0.910 m, +1.1°", "1.00 s of 1.00"),
    ]


@pytest.mark.parametrize(
    ("lines", "wrong"),
    [
        ((*OVERRIDE, *AFTER), "did not drive before the operator"),
        ((*BEFORE, *AFTER), "no command of the operator reached the wheels"),
        ((*BEFORE, (104.3, PERSON), *OVERRIDE[1:], *AFTER), "only after 300 ms"),
        ((*BEFORE, *OVERRIDE[:2], (104.95, AHEAD), OVERRIDE[2], *AFTER), "1 commands of the script passed"),
        ((*BEFORE, *OVERRIDE, (106.5, AHEAD), *AFTER), "1 commands of the script passed"),
        ((*BEFORE, *OVERRIDE), "did not drive again"),
        ((*BEFORE, *OVERRIDE, (110.0, AHEAD)), "drove again only after 5.0 s"),
    ],
)
def test_commands_that_reach_the_wheels_at_the_wrong_time(lines: Lines, wrong: str) -> None:
    assert any(wrong in one for one in judged(*lines).wrong)


def test_a_line_of_the_script_that_was_read_just_before_the_operators_is_none_of_the_override() -> None:
    assert judged(*BEFORE, (104.004, AHEAD), *OVERRIDE, *AFTER).wrong == ()


@pytest.mark.parametrize(
    ("outcome", "wrong"),
    [
        (replace(ARRIVED, distance_m=DISTANCE_M + 0.06), "0.96 m from the tag instead of 0.90"),
        (replace(ARRIVED, distance_m=DISTANCE_M - 0.06), "0.84 m from the tag"),
        (replace(ARRIVED, distance_m=float("nan")), "nan m from the tag"),
        (replace(ARRIVED, bearing_rad=0.2), "+11.5° to the left"),
        (replace(ARRIVED, played_s=0.5), "of horn.wav the loudspeaker played 0.50 s instead of 1.00"),
    ],
)
def test_a_wrong_outcome(outcome: Outcome, wrong: str) -> None:
    (found,) = judged(*BEFORE, *OVERRIDE, *AFTER, outcome=outcome).wrong
    assert wrong in found
