"""Our own robots pass the checker: those of the demo, whose motors are seen in the traces of their simulated boards."""

from __future__ import annotations

import pytest

from pebble.check_result import State
from pebble.extensions.checks.check import run
from pebble.extensions.checks.conform.checks import CHECKS, LAST
from pebble.extensions.checks.conform.control import CONTROL
from pebble.extensions.checks.conform.motion import MOVING
from pebble.extensions.checks.observer import observed
from pebble.extensions.lab.rig.testbed import ROBOTS
from pebble.extensions.operator.client.connection import Target
from tests.ext.page.stage import Stage

pytestmark = [pytest.mark.alone, pytest.mark.thorough]


@pytest.mark.parametrize("name", ROBOTS)
def test_a_robot_of_ours_passes(name: str) -> None:
    with (
        Stage(name) as stage,
        observed(Target(url=f"mqtt://127.0.0.1:{stage.broker_port}", robot=name), 4.0) as robot,
    ):
        robot.eyes = lambda: [(ns / 1e9, [*wheels]) for ns, wheels in stage.motors(name)]
        found = [
            (one.name, result) for one, result in run((*CHECKS, *CONTROL, *MOVING, *LAST), robot, refresh=robot.read)
        ]
    assert {name: result.text for name, result in found if result.state is not State.OK} == {}
