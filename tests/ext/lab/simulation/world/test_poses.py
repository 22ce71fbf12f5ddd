"""Poses between samples."""

from __future__ import annotations

import math

import pytest

from pebble.extensions.lab.simulation.world.poses import RobotPose, Sample, Track

TRACK = Track([Sample(100, RobotPose(0, 0, 3.0)), Sample(200, RobotPose(1, -2, -3.0)), Sample(300, RobotPose(1, 0, 0))])


def test_a_pose_between_two_samples_is_interpolated_the_short_way_round() -> None:
    x, y, heading = TRACK.at(150)
    assert (x, y) == (0.5, -1.0)
    assert math.remainder(heading - math.pi, math.tau) == pytest.approx(0.0)


@pytest.mark.parametrize(("ns", "pose"), [(0, (0, 0, 3.0)), (100, (0, 0, 3.0)), (200, (1, -2, -3.0)), (999, (1, 0, 0))])
def test_at_and_beyond_the_samples_a_pose_is_a_samples(ns: int, pose: tuple[float, float, float]) -> None:
    assert tuple(TRACK.at(ns)) == pytest.approx(pose)
