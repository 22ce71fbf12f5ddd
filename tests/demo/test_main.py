"""What the demo retains of many rounds."""

from __future__ import annotations

from pebble.demo.emergency import StopResult
from pebble.demo.following import FollowResult
from pebble.demo.main import retain_worst
from pebble.demo.view import Result


def test_of_each_robot_and_step_the_worst_round_stays() -> None:
    results: dict[tuple[str, str], Result] = {}
    follow = FollowResult("goob", ())
    slow, wrong = StopResult("goob", 0.5, None, ()), StopResult("goob", 0.1, None, ("its motors did not stop",))
    retain_worst(results, follow)
    for _ in range(1000):
        retain_worst(results, StopResult("goob", 0.1, None, ()))
    assert len(results) == 2
    retain_worst(results, slow)
    assert list(results.values()) == [follow, slow]
    retain_worst(results, wrong)
    retain_worst(results, slow)
    assert list(results.values()) == [follow, wrong]
