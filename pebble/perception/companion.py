"""Where another robot is, seen from this one, by the odometry of both. Pure.

Each odometry has a frame of its own, in which its robot began at zero. So only the motion since the last call counts,
and where the other one stood at the start has to be told.
"""

import math

from pebble.perception.odom_follow import Pose
from pebble.perception.tags import Place

_JUMP_M = 0.5  # between two calls: an odometry that has begun anew, no motion


class Companion:
    """``ahead_m`` and ``left_m``: where the other one stands at the first call, heading as this one does."""

    def __init__(self, ahead_m: float, left_m: float) -> None:
        self._seen = Pose(ahead_m, left_m, 0.0)  # from this robot
        self._mine: Pose | None = None
        self._its: Pose | None = None

    def place(self, mine: Pose, its: Pose) -> Place:
        """Where it is now."""
        moved = _motion(self._mine, mine)
        self._seen = _seen_from(moved, _after(self._seen, _motion(self._its, its)))
        self._mine, self._its = mine, its
        return Place(math.hypot(self._seen.x_m, self._seen.y_m), -math.atan2(self._seen.y_m, self._seen.x_m))


def _motion(before: Pose | None, now: Pose) -> Pose:
    """Return it in the frame of ``before``; none at a jump."""
    if before is None or math.hypot(now.x_m - before.x_m, now.y_m - before.y_m) > _JUMP_M:
        return Pose(0.0, 0.0, 0.0)
    return _seen_from(before, now)


def _seen_from(one: Pose, other: Pose) -> Pose:
    dx, dy = other.x_m - one.x_m, other.y_m - one.y_m
    cos, sin = math.cos(one.heading_rad), math.sin(one.heading_rad)
    return Pose(cos * dx + sin * dy, cos * dy - sin * dx, other.heading_rad - one.heading_rad)


def _after(pose: Pose, motion: Pose) -> Pose:
    """Where who is at ``pose`` is after a motion of its own."""
    cos, sin = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
    x, y = pose.x_m + cos * motion.x_m - sin * motion.y_m, pose.y_m + sin * motion.x_m + cos * motion.y_m
    return Pose(x, y, pose.heading_rad + motion.heading_rad)
