"""``pebble estop`` with a whole robot: from the operators' broker and from its own transport."""

from __future__ import annotations

import time

import pytest

from tests.commands.command_line import program
from tests.robot.operator import driving
from tests.robot.rig import BASE, STOP, Rig
from tests.support import until

pytestmark = pytest.mark.alone  # deadlines are checked


def pebble(*arguments: object) -> tuple[int, str]:
    process = program(*map(str, arguments))
    out, err = process.communicate(timeout=90)
    return process.returncode, out + err


@pytest.mark.parametrize("kind", ["mqtt", "zenoh"])
def test_a_stop_from_either_side_holds_over_restarts_until_its_reset(kind: str) -> None:
    with Rig(kind) as rig:
        remote = f"--url=mqtt://127.0.0.1:{rig.remote.port}"
        with driving(rig.operator, 0.5):
            assert until(rig.mcu.moving)
            code, printed = pebble("estop", BASE, remote, "--why", "dog")
            stopped = time.monotonic()
            assert (code, "stopped and confirmed after" in printed) == (0, True), printed
            rig.kill("serial_mcu_bridge")
            assert until(lambda: rig.processes().get("serial_mcu_bridge"))
            rig.stop()
            rig.start()
            assert {wheels for _, wheels in rig.mcu.drives(stopped)} <= {STOP}
            code, printed = pebble("topic", "pub", "drive-values", '{"z": 0.5}', "-c", rig.config)
            assert (code, "is stopped by" in printed, ": dog" in printed) == (1, True, True), printed
        code, printed = pebble("estop", "reset", rig.config)  # on the robot's own transport
        assert code == 0, printed
        rig.operator.send("incoming/drive-values", {"x": 0, "z": 0})  # without it the robot waits for half a second
        with driving(rig.operator, 0.5):
            assert until(rig.mcu.moving)
            code, printed = pebble("estop", rig.config)
            assert code == 0, printed
            assert not rig.mcu.moving()
        code, printed = pebble("estop", "reset", BASE, remote)
        assert (code, "stopped by" in printed) == (0, True), printed
        assert pebble("estop", "status", remote) == (0, f"{BASE.rpartition('/')[2]}: free\n")
