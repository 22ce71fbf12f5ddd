"""A world whose time the test advances, repeatable to the last bit; scripts on its clock; bodies that walls stop."""

from __future__ import annotations

import hashlib
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pebble import Robot
from pebble.extensions.lab.simulation.motion import FULL_SPEED_MM_S
from pebble.extensions.lab.simulation.world.lockstep import LockstepRobot, LockstepWorld
from pebble.extensions.lab.simulation.world.script_robot import SimulatedRobot
from pebble.extensions.lab.simulation.world.world_file import parse_world
from tests.ext.lab.simulation.world.worlds import tags_in, world_of

pytestmark = pytest.mark.computing

WORLD: dict[str, Any] = {
    "tags": [{"id": 13, "x": 3.0, "y": 0.0, "yaw_deg": 180.0}],
    "robots": {"goob": {"x": 0.0, "y": 0.0}, "fred": {"kind": "fred", "x": 1.0, "y": 0.6, "tag": 2}},
    "camera": {"latency_ms": 70.0, "motion_blur_ms": 20.0},
}


def follow(goob: LockstepRobot) -> bytes | np.ndarray:
    """Turn towards the tag and go to it; the picture that showed it, if there was one."""
    picture = goob.picture()
    if picture is None:
        return b""
    corners = tags_in(picture.pixels).get(13, np.full((1, 2), 500.0))
    goob.drive(x=(corners[:, 0].mean() - 319.5) / 1000, z=0.4)
    return picture.pixels


def history(seconds: float) -> str:
    simulated, digest = LockstepWorld(parse_world(WORLD)), hashlib.sha256()
    goob, fred = simulated.robots.values()
    fred.write(b"M 0.5 0.1\n")
    while simulated.now() < seconds:
        simulated.step()
        digest.update(follow(goob))
        digest.update(goob.read() + fred.read() + repr((goob.pose, fred.pose)).encode())
    return digest.hexdigest()


def test_two_runs_are_the_same_to_the_last_bit() -> None:
    assert history(0.5) == history(0.5)


def ahead(robot: Robot) -> None:
    while robot.drive(z=0.5):
        robot.sleep(0.1)


def test_a_script_moves_its_robot_and_leaves_it_at_rest(tmp_path: Path) -> None:
    (tmp_path / "world.json").write_text(json.dumps(WORLD))
    robot = SimulatedRobot(tmp_path / "world.json")
    robot.run(ahead, seconds=4.0)
    assert robot.distance_to(tag=13) == pytest.approx(3.0 - 4.0 * 0.19, abs=0.03)
    before = robot.body.pose
    robot.world.run(1.0)
    assert robot.body.pose.x == pytest.approx(before.x, abs=0.03)


# -- robots have bodies


WALL = {"x1": 1.0, "y1": 1.0, "x2": 1.0, "y2": -1.0}
TOUCH_M = 0.9  # x of a robot of radius 0.1 at the wall


def driven(seconds: float, left: float, right: float, world: LockstepWorld | None = None, **keys: Any) -> LockstepWorld:
    """Drive goob's wheels."""
    world = world or LockstepWorld(world_of(**keys))
    end = world.now() + seconds
    while world.now() < end:
        world.robots["goob"].write(b"M %.3f %.3f\n" % (left, right))
        world.run(0.1)
    return world


@pytest.mark.parametrize("heading_deg", [0.0, -40.0])
def test_a_wall_stops_a_robot_where_its_body_touches(heading_deg: float) -> None:
    world = driven(4.0, 1, 1, walls=[WALL], robots={"goob": {"x": 0.0, "y": 0.0, "heading_deg": heading_deg}})
    goob = world.robots["goob"]
    assert goob.pose.x == pytest.approx(TOUCH_M, abs=1e-4)
    assert goob.pose.y == pytest.approx(TOUCH_M * math.tan(math.radians(heading_deg)), abs=1e-3), "it does not slide"
    assert goob.pose.heading == pytest.approx(math.radians(heading_deg))
    before = goob.motion.left_mm
    driven(1.0, 1, 1, world)
    assert goob.motion.left_mm - before == pytest.approx(FULL_SPEED_MM_S, rel=0.05), "the wheels slip and count on"
    driven(1.0, -1, -1, world)
    assert goob.pose.x < TOUCH_M - 0.2, "it drives away"


def test_robots_stop_each_other_and_neither_is_pushed() -> None:
    world = LockstepWorld(parse_world({"robots": {"goob": {"x": 0.0, "y": 0.0}, "fred": {"x": 1.0, "y": 0.0}}}))
    fred = world.robots["fred"].pose
    driven(4.0, 1, 1, world)
    assert world.robots["fred"].pose == fred
    assert world.robots["goob"].pose.x == pytest.approx(0.8, abs=1e-4)
