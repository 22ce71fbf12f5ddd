"""Follows another robot of the LAN by the odometry of both, and holds a distance from it. No camera is needed."""

import time
from typing import Annotated

from msgspec import Meta, Struct, convert

from pebble import Robot, run
from pebble.contract import WHEEL_ODOMETRY
from pebble.perception.companion import Companion
from pebble.perception.follow import Follower, FollowSettings
from pebble.perception.odom_follow import pose_of
from pebble.runtime.rate_limit import RateLimitedLog

POSE_AGE_S = 1.0  # odometry is published twice a second at rest

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


def main(robot: Robot, options: Options) -> None:
    """Both robots head in the same direction at the start."""
    other, log = robot.neighbour(options.robot), RateLimitedLog(robot.log, period_s=10.0)
    follower = Follower(convert(options, FollowSettings, from_attributes=True))
    companion = Companion(options.ahead_m, options.left_m)
    while True:
        mine, its = (pose_of(one.latest(WHEEL_ODOMETRY, POSE_AGE_S)) for one in (robot, other))
        if mine is None or its is None:
            log.warning("odometry", "waits for the odometry of %s", options.robot if its is None else "this robot")
            robot.stop()
        else:
            command = follower.step(time.monotonic(), companion.place(mine, its))
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
