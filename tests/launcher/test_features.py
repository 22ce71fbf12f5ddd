"""What processes report that they lack or have: it counts until they report the opposite, or end."""

from __future__ import annotations

import os
import signal

from pebble.launcher.features import Features
from pebble.runtime import notes
from pebble.runtime.notes import Feature
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
    for program, has in [("left", False), ("left", False), ("right", False), ("left", True), ("other", True)]:
        recorder.features.receive(program, Feature("estop", has))
    assert recorder.changes == [{"estop"}]
    recorder.features.receive("right", Feature("estop", True))
    assert recorder.changes == [{"estop"}, set()]


def test_the_end_of_a_process_ends_what_it_reported() -> None:
    recorder = Recorder()
    recorder.features.receive("left", Feature("estop", False))
    recorder.features.ended("right")
    assert recorder.features.lacking == {"estop"}
    recorder.features.ended("left")
    assert recorder.changes == [{"estop"}, set()]


def test_what_is_not_expected_is_there_while_any_process_has_it() -> None:
    recorder = Recorder()
    for program, has in [("a", False), ("a", True), ("b", True), ("a", False)]:
        recorder.features.receive(program, Feature("outlets/o/power", has))
    assert recorder.features.found == {"outlets/o/power"}
    assert not recorder.features.lacking
    recorder.features.ended("b")
    assert recorder.changes == [{"outlets/o/power"}, set()]


def test_an_outlet_may_have_any_name_and_there_are_limits() -> None:
    recorder = Recorder()
    for name in ("Küche 1/power", *(f"{number}/status" for number in range(300))):
        note = notes.decode(notes.encode(Feature(f"outlets/{name}", True)))
        assert isinstance(note, Feature)
        recorder.features.receive("a", note)
    assert len(recorder.features.found) == 256
    recorder.features.receive("a", Feature("outlets/1/status", False))
    assert len(recorder.features.found) == 255


def test_capabilities_are_published_again_when_a_process_reports_and_when_it_ends(launch: Launch) -> None:
    robot = launch(("motors", "asker", CONNECTION))
    assert robot.ready("motors")
    assert len(robot.published("capabilities")) == 1
    robot.order("motors", "lacks estop", "lacks nothing")
    assert until(lambda: len(robot.published("capabilities")) == 2)
    os.kill(robot.events("motors", "start")[0], signal.SIGKILL)
    assert until(lambda: len(robot.published("capabilities")) == 3)
    assert "motors wrote what is no note, ignored: " in robot.stderr()
