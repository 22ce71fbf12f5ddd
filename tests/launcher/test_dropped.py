"""What processes report as dropped is in the status until they end."""

from __future__ import annotations

import os
import signal

import pytest

from pebble.launcher.dropped import Dropped
from tests.launcher.robot import CONNECTION, Launch
from tests.support import until


def test_the_newest_report_of_each_process_counts_until_its_end() -> None:
    dropped = Dropped()
    for program, line in [("a", "too_large=1"), ("a", "too_large=3 late=12"), ("b", "no_room=1")]:
        assert dropped.receive(program, f"DROPPED {line}")
    assert (dropped["a"], dropped["b"], dropped["c"]) == ({"too_large": 3, "late": 12}, {"no_room": 1}, {})
    dropped.ended("a")
    assert (dropped["a"], dropped["b"]) == ({}, {"no_room": 1})


@pytest.mark.parametrize(
    "line", ["", "DROPPED", "DROPPED ", "DROPPED a", "DROPPED a=-1", "DROPPED A=1", "DROPPED a=1 b", "HAS estop"]
)
def test_other_lines_are_no_reports(line: str) -> None:
    dropped = Dropped()
    assert not dropped.receive("a", line)
    assert dropped["a"] == {}


def test_the_number_of_reasons_is_bounded() -> None:
    dropped = Dropped()
    assert dropped.receive("a", "DROPPED " + " ".join(f"{letter}=1" for letter in "abcdefghijklmnopqrstuvwxyz"))
    assert len(dropped["a"]) == 16


def test_the_status_shows_it_and_forgets_it_with_the_process(launch: Launch) -> None:
    robot = launch(("motors", "asker", CONNECTION))
    assert robot.ready("motors")
    well = {"state": "ready", "restarts": 0, "last_exit": None}
    assert robot.services()["motors"] == well
    robot.order("motors", "dropped too_large=3")
    assert until(lambda: robot.services()["motors"] == {**well, "dropped": {"too_large": 3}})
    os.kill(robot.events("motors", "start")[0], signal.SIGKILL)
    assert until(lambda: robot.services()["motors"] == {"state": "ready", "restarts": 1, "last_exit": "signal 9"})
