"""What processes report that they lack or have: it counts until they report the opposite, or end."""

from __future__ import annotations

import os
import signal

import pytest

from pebble.launcher.features import Features
from tests.launcher.robot import CONNECTION, Launch
from tests.support import until


class Recorder:
    """`Features`, and what is lacking or found after each change."""

    def __init__(self) -> None:
        self.changes: list[set[str]] = []
        self.features = Features(self._changed)

    def _changed(self) -> None:
        self.changes.append({*self.features.lacking, *self.features.found})


def test_a_feature_is_lacking_while_any_process_lacks_it() -> None:
    recorder = Recorder()
    for program, line in [("left", "LACKS"), ("left", "LACKS"), ("right", "LACKS"), ("left", "HAS"), ("other", "HAS")]:
        assert recorder.features.receive(program, f"{line} estop")
    assert recorder.changes == [{"estop"}]
    recorder.features.receive("right", "HAS estop")
    assert recorder.changes == [{"estop"}, set()]


def test_the_end_of_a_process_ends_what_it_reported() -> None:
    recorder = Recorder()
    recorder.features.receive("left", "LACKS estop")
    recorder.features.ended("right")
    assert recorder.features.lacking == {"estop"}
    recorder.features.ended("left")
    assert recorder.changes == [{"estop"}, set()]


def test_what_is_not_expected_is_there_while_any_process_has_it() -> None:
    recorder = Recorder()
    for program, line in [("a", "LACKS"), ("a", "HAS"), ("b", "HAS"), ("a", "LACKS")]:
        assert recorder.features.receive(program, f"{line} outlets/o/power")
    assert recorder.features.found == {"outlets/o/power"}
    assert not recorder.features.lacking
    recorder.features.ended("b")
    assert recorder.changes == [{"outlets/o/power"}, set()]


def test_an_outlet_may_have_any_name_and_there_are_limits() -> None:
    recorder = Recorder()
    assert recorder.features.receive("a", "HAS outlets/Küche 1/power")
    for number in range(300):
        recorder.features.receive("a", f"HAS outlets/{number}/status")
    assert len(recorder.features.found) == 256
    assert recorder.features.receive("a", "LACKS outlets/1/status")
    assert len(recorder.features.found) == 255


@pytest.mark.parametrize(
    "line",
    [
        "",
        "LACKS",
        "LACKS ",
        "LACKS drive",
        "lacks estop",
        "LACKS estop 1",
        "LACKS estop\n",
        "WANT media 1",
        "HAS outlets/a/b",
    ],
)
def test_other_lines_are_no_reports(line: str) -> None:
    recorder = Recorder()
    assert not recorder.features.receive("left", line)
    assert recorder.changes == []


def test_capabilities_are_published_again_when_a_process_reports_and_when_it_ends(launch: Launch) -> None:
    robot = launch(("motors", "asker", CONNECTION))
    assert robot.ready("motors")
    assert len(robot.published("capabilities")) == 1
    robot.order("motors", "lacks estop", "lacks nothing")
    assert until(lambda: len(robot.published("capabilities")) == 2)
    os.kill(robot.events("motors", "start")[0], signal.SIGKILL)
    assert until(lambda: len(robot.published("capabilities")) == 3)
    assert "motors may not request this, ignored: LACKS nothing" in robot.stderr()
