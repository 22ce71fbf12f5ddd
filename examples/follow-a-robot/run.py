"""Follows another robot of the LAN by the odometry of both, and holds a distance from it. No camera is needed.

Copy its folder to the robot's scripts (`services.autonomy_manager.autonomy_root`), and it is offered there.
"""

import cmath
import time
from typing import Annotated

from msgspec import Meta, Struct, convert

from pebble import Robot, run
from pebble.contract import WHEEL_ODOMETRY
from pebble.perception.follow import Follower, FollowSettings
from pebble.perception.odom_follow import Pose, pose_of
from pebble.perception.tags import Place
from pebble.runtime.rate_limit import RateLimitedLog

POSE_AGE_S = 1.0  # odometry is published twice a second at rest
JUMP_M = 0.5  # between two calls: an odometry that has begun anew, no motion

Power = Annotated[float, Meta(ge=0, le=1)]


class Options(Struct, kw_only=True):
    robot: Annotated[str, Meta(min_length=1, title="Robot", description="Its id, as in neighbours.listens.")] = "fred"
    ahead_m: Annotated[float, Meta(ge=-20, le=20, title="How Far Ahead It Stands at the Start (m)")] = 0.6
    left_m: Annotated[float, Meta(ge=-20, le=20, title="How Far to the Left It Stands at the Start (m)")] = 0.0
    target_distance_m: Annotated[float, Meta(ge=0.05, le=20, title="Distance to Hold (m)")] = 0.6
    distance_threshold_m: Annotated[float, Meta(ge=0, le=5, title="Distance Threshold (m)")] = 0.05
    forward_min_power: Annotated[Power, Meta(title="Forward Min Power")] = 0.3
    forward_max_power: Annotated[Power, Meta(title="Forward Max Power")] = 1.0
    turn_power: Annotated[float, Meta(ge=0.05, le=1, title="Turn Power")] = 0.5
    control_rate_hz: Annotated[float, Meta(ge=5, le=50, title="Control Rate (Hz)")] = 10.0


class Companion:
    """The place of another robot, seen from this one. Each odometry has a frame of its own, so only motions count.

    ``ahead_m`` and ``left_m``: the other robot's place at the first call, when both head in the same direction.
    """

    def __init__(self, ahead_m: float, left_m: float) -> None:
        self._seen = complex(ahead_m, left_m)  # where it is, seen from this robot
        self._turned_rad = 0.0  # how far it has turned to the left of this robot's heading
        self._poses: tuple[Pose, Pose] | None = None  # of this robot and the other, at the last call

    def place(self, mine: Pose, its: Pose) -> Place:
        """Return the other robot's place. ``mine`` and ``its``: the newest poses, each in its own odometry's frame."""
        my_last, its_last = self._poses or (mine, its)
        self._poses = (mine, its)
        step, turn_rad = _motion(my_last, mine)
        its_step, its_turn_rad = _motion(its_last, its)
        self._seen += its_step * cmath.rect(1, self._turned_rad)  # its step, in this robot's frame
        self._seen = (self._seen - step) * cmath.rect(1, -turn_rad)  # seen from where this robot is now
        self._turned_rad += its_turn_rad - turn_rad
        return Place(abs(self._seen), -cmath.phase(self._seen))  # a Place's angle is positive to the right


def _motion(before: Pose, now: Pose) -> tuple[complex, float]:
    """Return the step in the frame of ``before``, and the turn; both 0 if the odometry has restarted in between."""
    step = complex(now.x_m - before.x_m, now.y_m - before.y_m)
    if abs(step) > JUMP_M:
        return 0j, 0.0
    return step * cmath.rect(1, -before.heading_rad), now.heading_rad - before.heading_rad


def main(robot: Robot, options: Options) -> None:
    """Follow the other robot. Both head in the same direction at the start."""
    other, log = robot.neighbour(options.robot), RateLimitedLog(robot.log, period_s=10.0)
    follower = Follower(convert(options, FollowSettings, from_attributes=True))
    companion = Companion(options.ahead_m, options.left_m)
    while True:
        own_pose, other_pose = (pose_of(machine.latest(WHEEL_ODOMETRY, POSE_AGE_S)) for machine in (robot, other))
        if own_pose is None or other_pose is None:
            log.warning(
                "odometry", "waits for the odometry of %s", options.robot if other_pose is None else "this robot"
            )
            robot.stop()
        else:
            command = follower.step(time.monotonic(), companion.place(own_pose, other_pose))
            robot.drive(command.x, command.z)
        robot.sleep(1 / options.control_rate_hz)


if __name__ == "__main__":
    run(
        main,
        label="Follow a robot",
        summary="Drives behind another robot, by what both know of their wheels.",
        main_options=("robot", "ahead_m", "target_distance_m"),
        needs={WHEEL_ODOMETRY.metric: {"use_tune_state": False}},
    )
