"""Robots have bodies: walls and other robots stop them, their wheels slip, and they can always leave."""

from __future__ import annotations

import math
from typing import Any

import pytest

from pebble.extensions.lab.simulation.motion import FULL_SPEED_MM_S
from pebble.extensions.lab.simulation.world.lockstep import LockstepWorld
from pebble.extensions.lab.simulation.world.world_file import parse_world
from tests.ext.lab.simulation.world.worlds import world_of

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
