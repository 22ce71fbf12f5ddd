"""What the demo retains of many rounds, and of what went wrong on an overloaded machine."""

from __future__ import annotations

from pebble.demo.emergency import StopResult
from pebble.demo.following import FollowResult
from pebble.demo.results import Results

RIGHT, SLOW = StopResult("goob", 0.1, None, ()), StopResult("goob", 0.5, None, ())
WRONG = StopResult("goob", 0.1, None, ("its motors did not stop",))
BUSY = "35% of the processors were taken by other guests, 0% were idle"


def test_of_each_robot_and_step_the_worst_round_stays() -> None:
    results, follow = Results(), FollowResult("goob", ())
    results.add(follow)
    for _ in range(1000):
        results.add(RIGHT)
    assert results.all() == [follow, RIGHT]
    results.add(SLOW)
    assert results.all() == [follow, SLOW]
    results.add(WRONG)
    results.add(SLOW)
    assert results.all() == [follow, WRONG]
    assert results.problems() == ["goob, emergency stop: its motors did not stop"]


def test_what_went_wrong_on_an_overloaded_machine_counts_until_it_goes_right() -> None:
    results = Results()
    results.add(WRONG, BUSY)
    assert list(results.doubtful) == [("goob", "emergency stop")]
    assert results.problems() == [
        f"goob, emergency stop: its motors did not stop (this machine was overloaded and could not keep up: {BUSY})"
    ]
    results.add(WRONG, BUSY)
    assert results.doubtful
    results.add(SLOW, BUSY)
    assert (results.all(), results.doubtful, results.problems()) == ([SLOW], {}, [])
    results.add(WRONG, BUSY)  # it has been seen to go right
    assert (results.all(), results.doubtful) == ([SLOW], {})


def test_what_goes_wrong_on_a_machine_that_keeps_up_stays_wrong() -> None:
    results = Results()
    results.add(WRONG, BUSY)
    results.add(WRONG)
    assert not results.doubtful
    results.add(RIGHT)
    assert results.all() == [WRONG]
