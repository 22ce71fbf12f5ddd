"""The programs in docs/ext/scripts.md run as they stand there."""

from __future__ import annotations

import os
import re
import sys
from contextlib import ExitStack
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from pebble.contract import WHEEL_ODOMETRY, Channel
from pebble.contract.payloads import WheelOdometry
from pebble.extensions.lab.simulation.world.script_robot import SimulatedRobot
from tests.ext.scripts.autonomy_manager.manager_rig import ManagerRig
from tests.support import ROOT, Broker, gone, until

TEXT = (ROOT / "docs/ext/scripts.md").read_text()
ROOM = ROOT / "pebble/extensions/lab/simulation/world/room.json"


def blocks(language: str, beginning: str = "") -> list[str]:
    return [block for block in re.findall(rf"```{language}\n(.*?)```", TEXT, re.DOTALL) if block.startswith(beginning)]


def module(text: str) -> ModuleType:
    made = ModuleType("run")
    exec(compile(text, "docs/ext/scripts.md", "exec"), vars(made))
    return made


class Driven(SimulatedRobot):
    """Its odometry is the truth, until it ends."""

    odometry_ends_at = float("inf")

    def latest(self, channel: Channel, max_age: float = 1.0) -> Any:
        start = self._start = getattr(self, "_start", self.body.pose)
        if self.world.now() < self.odometry_ends_at:
            way = ((self.body.pose.x - start.x) ** 2 + (self.body.pose.y - start.y) ** 2) ** 0.5
            self.receive(WHEEL_ODOMETRY, WheelOdometry(value={"x_mm": 1000 * way}, timestamp=0.0))
        return super().latest(channel, max_age)


def test_the_first_script_is_what_pebble_script_new_writes() -> None:
    assert blocks("python", '"""Follow a tag') == [
        (ROOT / "pebble/extensions/scripts/commands/starter/run.py.txt").read_text()
    ]


@pytest.mark.parametrize(("ends_at", "way_m"), [(float("inf"), 0.5), (1.5, 0.25)])
def test_a_loop_of_its_own_never_acts_on_what_is_old(ends_at: float, way_m: float) -> None:
    robot = Driven(ROOM)
    robot.odometry_ends_at = ends_at
    start = robot.body.pose
    (text,) = blocks("python", '"""Drive half a metre')
    robot.run(module(text).main, seconds=8.0)
    end = robot.body.pose
    assert ((end.x - start.x) ** 2 + (end.y - start.y) ** 2) ** 0.5 == pytest.approx(way_m, abs=0.06)


def test_a_channel_of_its_own() -> None:
    (text,) = blocks("python", "from pebble import Channel")
    assert module(text).MOOD.topic("pebble/robots/goob") == "pebble/robots/goob/outgoing/mood"


def test_a_script_in_shell(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The manager passes its options, and stops the wheels."""
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    (script,), (manifest,) = blocks("sh"), blocks("json")
    with ExitStack() as ends:
        broker = Broker(tmp_path)
        ends.callback(broker.stop)
        rig = ends.enter_context(ManagerRig("mqtt", broker.port))
        folder = rig.script("turn", script, "turn.sh")
        (folder / "script.json").write_text(manifest)
        rig.start()
        pid = rig.run_script("turn", power=0.3)
        assert until(lambda: {"x": 0.3} in [{"x": drive.get("x")} for drive in rig.drives], 20), rig.logged()
        rig.command({"action": "stop"})
        assert rig.becomes(running=False)
        assert gone(pid)
        assert until(lambda: not any(rig.drives[-1].get(axis, 0.0) for axis in "xz"))
        assert {drive.get("source") for drive in rig.drives} == {"autonomy", "autonomy_manager", None}
