"""The programs in docs/ext/scripts.md run as they stand there."""

from __future__ import annotations

import re
from types import ModuleType
from typing import Any

import pytest

from pebble.contract import WHEEL_ODOMETRY, Channel
from pebble.contract.payloads import WheelOdometry
from pebble.extensions.lab.simulation.world.script_robot import SimulatedRobot
from tests.support import ROOT

TEXT = (ROOT / "docs/ext/scripts.md").read_text()
ROOM = ROOT / "pebble/extensions/lab/simulation/world/room.json"


def blocks(language: str, beginning: str = "") -> list[str]:
    return [block for block in re.findall(rf"```{language}\n(.*?)```", TEXT, re.DOTALL) if block.startswith(beginning)]


def module(text: str) -> ModuleType:
    made = ModuleType("run")
    exec(compile(text, "docs/ext/scripts.md", "exec"), vars(made))
    return made


class Driven(SimulatedRobot):
    """Its odometry is the truth, until it ends after 1.5 s: half of the way."""

    def latest(self, channel: Channel, max_age: float = 1.0) -> Any:
        start = self._start = getattr(self, "_start", self.body.pose)
        if self.world.now() < 1.5:
            way = ((self.body.pose.x - start.x) ** 2 + (self.body.pose.y - start.y) ** 2) ** 0.5
            self.receive(WHEEL_ODOMETRY, WheelOdometry(value={"x_mm": 1000 * way}, timestamp=0.0))
        return super().latest(channel, max_age)


def test_the_first_script_is_what_pebble_script_new_writes() -> None:
    assert blocks("python", '"""Follow a tag') == [
        (ROOT / "pebble/extensions/scripts/commands/starter/run.py.txt").read_text()
    ]


def test_a_loop_of_its_own_never_acts_on_what_is_old() -> None:
    robot = Driven(ROOM)
    start = robot.body.pose
    (text,) = blocks("python", '"""Drive half a metre')
    robot.run(module(text).main, seconds=4.0)
    end = robot.body.pose
    assert ((end.x - start.x) ** 2 + (end.y - start.y) ** 2) ** 0.5 == pytest.approx(0.25, abs=0.06)
