"""What processes report that they lack: it counts until they have it again, or end."""

from __future__ import annotations

import os
import signal

import pytest

from pebble.launcher.lacking import Lacking
from tests.launcher.robot import CONNECTION, Launch
from tests.support import until


class Recorder:
    """A `Lacking`, and the features after each change."""

    def __init__(self) -> None:
        self.changes: list[set[str]] = []
        self.lacking = Lacking(lambda: self.changes.append(set(self.lacking.features)))


def test_a_feature_is_lacking_while_any_process_lacks_it() -> None:
    recorder = Recorder()
    for program, line in [("left", "LACKS"), ("left", "LACKS"), ("right", "LACKS"), ("left", "HAS"), ("other", "HAS")]:
        assert recorder.lacking.receive(program, f"{line} estop")
    assert recorder.changes == [{"estop"}]
    recorder.lacking.receive("right", "HAS estop")
    assert recorder.changes == [{"estop"}, set()]


def test_the_end_of_a_process_ends_what_it_reported() -> None:
    recorder = Recorder()
    recorder.lacking.receive("left", "LACKS estop")
    recorder.lacking.ended("right")
    assert recorder.lacking.features == {"estop"}
    recorder.lacking.ended("left")
    assert recorder.changes == [{"estop"}, set()]


@pytest.mark.parametrize(
    "line", ["", "LACKS", "LACKS ", "LACKS drive", "lacks estop", "LACKS estop 1", "LACKS estop\n", "WANT media 1"]
)
def test_other_lines_are_no_reports(line: str) -> None:
    recorder = Recorder()
    assert not recorder.lacking.receive("left", line)
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
