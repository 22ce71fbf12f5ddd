"""What processes report that they lack or have: it counts until they report the opposite, or end."""

from __future__ import annotations

import os
import re
import signal
from typing import cast

import pytest

from pebble.launcher.features import Features
from pebble.runtime import notes
from pebble.runtime.notes import Feature
from tests.launcher.robot import CONNECTION, Launch
from tests.support import until

#: Who lacks (-) or has (+) a feature or ends (.), and what is lacking and found after each change.
HISTORIES: dict[str, tuple[str, list[set[str]]]] = {
    "lacking while any lacks it": ("l-estop l-estop r-estop l+estop other+estop r+estop", [{"-estop"}, set()]),
    "the end of a process": ("l-estop r. l.", [{"-estop"}, set()]),
    "found while any has it": ("a-outlets/o/power a+outlets/o/power b+outlets/o/power a-outlets/o/power b.",
                               [{"+outlets/o/power"}, set()]),
    "what is lacked is not found": ("a-outlets/o/power", []),
}  # fmt: skip


@pytest.mark.parametrize(("history", "changes"), HISTORIES.values(), ids=HISTORIES)
def test_reports_of_processes_are_merged(history: str, changes: list[set[str]]) -> None:
    seen: list[set[str]] = []

    def changed() -> None:
        seen.append({f"-{name}" for name in features.lacking} | {f"+{name}" for name in features.found})

    features = Features(changed)
    for program, mark, name in re.findall(r"(\w+)([-+.])(\S*)", history):
        if mark == ".":
            features.ended(program)
        else:
            features.receive(program, Feature(name, mark == "+"))
    assert seen == changes


def test_an_outlet_may_have_any_name_and_there_are_limits() -> None:
    features = Features(lambda: None)
    for name in ("Küche 1/power", *(f"{number}/status" for number in range(300))):
        features.receive("a", cast(Feature, notes.decode(notes.encode(Feature(f"outlets/{name}", True)))))
    assert len(features.found) == 256


def test_capabilities_are_published_again_when_a_process_reports_and_when_it_ends(launch: Launch) -> None:
    robot = launch(("motors", "asker", CONNECTION))
    assert robot.ready("motors")
    assert len(robot.published("capabilities")) == 1
    robot.order("motors", "lacks estop", "lacks nothing")
    assert until(lambda: len(robot.published("capabilities")) == 2)
    os.kill(robot.events("motors", "start")[0], signal.SIGKILL)
    assert until(lambda: len(robot.published("capabilities")) == 3)
    assert "motors wrote what is no note, ignored: " in robot.stderr()
