"""A world whose time the test advances: repeatable to the last bit, faster than the real one."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest

from pebble.extensions.lab.simulation.world.lockstep import LockstepRobot, LockstepWorld
from pebble.extensions.lab.simulation.world.world_file import World, parse_world
from tests.ext.lab.simulation.world.worlds import tags_in

pytestmark = pytest.mark.computing

TAG = {"id": 13, "x": 3.0, "y": 0.0, "yaw_deg": 180.0}


def world(**camera: float) -> World:
    robots = {"goob": {"x": 0.0, "y": 0.0, "tag": 1}, "fred": {"kind": "fred", "x": 1.0, "y": 0.6, "tag": 2}}
    return parse_world({"tags": [TAG], "robots": robots, "camera": camera})


def follow(goob: LockstepRobot) -> bytes | np.ndarray:
    """Turn towards the tag and go to it; the picture that showed it, if there was one."""
    picture = goob.picture()
    if picture is None:
        return b""
    corners = tags_in(picture.pixels).get(13, np.full((1, 2), 500.0))
    goob.drive(x=(corners[:, 0].mean() - 319.5) / 1000, z=0.4)
    return picture.pixels


def history(seconds: float) -> str:
    simulated, digest = LockstepWorld(world(latency_ms=70.0, motion_blur_ms=20.0)), hashlib.sha256()
    goob, fred = simulated.robots.values()
    fred.write(b"M 0.5 0.1\n")
    while simulated.now() < seconds:
        simulated.step()
        digest.update(follow(goob))
        digest.update(goob.read() + fred.read() + repr((goob.pose, fred.pose)).encode())
    return digest.hexdigest()


def test_two_runs_are_the_same_to_the_last_bit() -> None:
    assert history(0.5) == history(0.5)
