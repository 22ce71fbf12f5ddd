"""Scripts on a virtual clock, as they are."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pebble import Robot
from pebble.extensions.lab.simulation.world.script_robot import SimulatedRobot

WORLD = {"tags": [{"id": 13, "x": 3.0, "y": 0.0, "yaw_deg": 180.0}], "robots": {"goob": {"x": 0.0, "y": 0.0}}}


@pytest.fixture
def robot(tmp_path: Path) -> SimulatedRobot:
    (tmp_path / "world.json").write_text(json.dumps(WORLD))
    return SimulatedRobot(tmp_path / "world.json")


def ahead(robot: Robot) -> None:
    while robot.drive(z=0.5):
        robot.sleep(0.1)


def test_a_script_moves_its_robot_and_leaves_it_at_rest(robot: SimulatedRobot) -> None:
    robot.run(ahead, seconds=4.0)
    assert robot.distance_to(tag=13) == pytest.approx(3.0 - 4.0 * 0.19, abs=0.03)
    before = robot.body.pose
    robot.world.run(1.0)
    assert robot.body.pose.x == pytest.approx(before.x, abs=0.03)
