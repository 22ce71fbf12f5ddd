"""Where another robot is, by the odometry of both."""

from __future__ import annotations

import math
import runpy

import pytest

from pebble.extensions.scripts.perception.odom_follow import Pose
from pebble.extensions.scripts.perception.tags import Place
from tests.support import ROOT

AT_0 = Pose(0.0, 0.0, 0.0)
AHEAD, HALF, QUARTER = Pose(0.4, 0.0, 0.0), Pose(0.2, 0.0, 0.0), math.pi / 2

#: Poses of this robot and of the other one, from the first call on, and where it is at last: metres ahead and left.
WAYS: dict[str, tuple[list[tuple[Pose, Pose]], tuple[float, float]]] = {
    "both stand": ([(AT_0, AT_0), (AT_0, AT_0)], (0.6, 0.0)),
    "it drives ahead": ([(AT_0, AT_0), (AT_0, AHEAD)], (1.0, 0.0)),
    "this one follows": ([(AT_0, AT_0), (AT_0, AHEAD), (AHEAD, AHEAD)], (0.6, 0.0)),
    "this one turns left": ([(AT_0, AT_0), (Pose(0, 0, QUARTER), AT_0)], (0.0, -0.6)),
    "it turns left, and drives": ([(AT_0, AT_0), (AT_0, Pose(0, 0.3, QUARTER))], (0.6, 0.3)),
    "its odometry had begun long before": ([(AT_0, Pose(7, 7, 1)), (AT_0, Pose(7, 7, 1))], (0.6, 0.0)),
    "its odometry begins anew": ([(AT_0, Pose(5, 0, 0)), (AT_0, Pose(5.2, 0, 0)), (AT_0, AT_0)], (0.8, 0.0)),
    "and goes on": ([(AT_0, Pose(5, 0, 0)), (AT_0, AT_0), (AT_0, HALF)], (0.8, 0.0)),
    "this one's begins anew": ([(Pose(3, 0, 0), AT_0), (AT_0, HALF), (HALF, HALF)], (0.6, 0.0)),
}


@pytest.mark.parametrize("way", WAYS)
def test_it_is_known_where_it_is(way: str) -> None:
    poses, (ahead, left) = WAYS[way]
    companion = runpy.run_path(str(ROOT / "examples" / "follow-a-robot" / "run.py"))["Companion"](0.6, 0.0)
    place = [companion.place(mine, its) for mine, its in poses][-1]
    assert place == pytest.approx(Place(math.hypot(ahead, left), -math.atan2(left, ahead)))
