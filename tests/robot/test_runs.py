"""A stranger who signs as a script, on a whole robot: from outside, and where nothing stands between.

tests/ext/scripts/runtime/test_runs.py has the rule.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.robot.operator import Operator
from tests.robot.rig import Rig
from tests.support import further, until

SCRIPT = """
from msgspec import Struct
from pebble import Robot, run
class Options(Struct): pass
def main(robot: Robot, options: Options) -> None:
    while True:
        robot.drive(z=0.3); robot.sleep(0.05)
run(main)
"""
OWN, THEIRS = (0.3, 0.3), (0.61, 0.61)
HALF, LAST = 1 << 29, (1 << 30) - 1
NUMBERS = (1, HALF - 1, HALF, HALF + 1, LAST, LAST + 1, -1, True, 1.5, "7")


def strange(sender: Operator) -> None:
    for z in (0.61, 0):
        for run in NUMBERS:
            sender.send("incoming/drive-values", {"x": 0, "z": z, "source": "autonomy", "run": run})


@pytest.fixture(params=[further("mqtt"), "zenoh", "single"])
def rig(request: pytest.FixtureRequest, tmp_path: Path) -> Rig:
    (folder := tmp_path / "scripts" / "go").mkdir(parents=True)
    (folder / "run.py").write_text(SCRIPT)
    return Rig(request.param, direct=True, autonomy_manager={"enabled": True, "autonomy_root": str(folder.parent)})


def moves(rig: Rig) -> None:
    """The script is started and drives."""
    since = time.monotonic()
    assert until(lambda: "go" in str(rig.operator.last("outgoing/autonomy-files")))

    def driven() -> bool:
        rig.operator.send("incoming/autonomy-command", {"action": "start", "file": "go"})
        return until(lambda: OWN in [drive for _, drive in rig.mcu.drives(since)], 3)

    assert until(driven, 20), rig.log.read_text()


@pytest.mark.thorough
def test_the_next_script_drives_whatever_a_stranger_has_sent(rig: Rig) -> None:
    with rig:
        moves(rig)
        since = time.monotonic()
        outside = rig.kind != "single"
        strange(rig.operator)
        assert until(lambda: "only programs on the robot" in rig.log.read_text()) == outside
        assert (THEIRS in [drive for _, drive in rig.mcu.drives(since)]) != outside
        moves(rig)
        strange(rig.operator)
        kills: list[Callable[[], object]] = [
            lambda: rig.kill("autonomy_manager"),
            lambda: rig.kill("serial_mcu_bridge"),
        ]
        for kill in kills:
            kill()
            moves(rig)
