"""The judgement of an emergency stop, by traces of robots that obey and that misbehave."""

import pytest

from pebble.demo.emergency import StopResult, assess
from pebble.demo.operator import CompletedStop
from pebble.simulation.trace import Entry

PRESSED, RESET, ENDED = 100.0, 102.0, 104.0
OBEYS = ((99.5, True), (100.01, False), (103.0, True), (104.1, False))


def judged(*motors: tuple[float, bool], confirmed_s: float | None = 0.05, is_free: bool = True) -> StopResult:
    entries = [Entry(round(at * 1e9), "motors", "0.500 0.500" if runs else "0.000 0.000") for at, runs in motors]
    return assess(CompletedStop("goob", PRESSED - 0.8, PRESSED, confirmed_s, RESET, is_free, ENDED), entries)


def test_a_robot_that_stops_and_moves_again_after_the_reset() -> None:
    result = judged(*OBEYS)
    assert result.wrong == ()
    assert result.stop_s == pytest.approx(0.01)
    assert result.summary == "off 10, confirmed 50 ms"


@pytest.mark.parametrize(
    ("motors", "wrong"),
    [
        (OBEYS[1:], "it did not move when it was stopped"),
        ((OBEYS[0], OBEYS[2]), "its motors did not stop"),
        ((OBEYS[0], (101.5, False), *OBEYS[2:]), "its motors did not stop"),
        ((*OBEYS[:2], (101.0, True), (101.1, False), *OBEYS[2:]), "its motors ran before the reset"),
        (OBEYS[:2], "it did not move after the reset"),
    ],
)
def test_robots_that_misbehave(motors: tuple[tuple[float, bool], ...], wrong: str) -> None:
    assert wrong in judged(*motors).wrong


def test_a_robot_that_does_not_answer() -> None:
    assert judged(*OBEYS, confirmed_s=None).wrong == ("it did not confirm the stop",)
    assert judged(*OBEYS, is_free=False).wrong == ("the reset was not confirmed",)
