"""Follows an AprilTag that another script finds, and drives on by odometry while the tag is out of sight."""

import time
from pathlib import Path
from typing import Annotated

from msgspec import Meta, Struct, convert

from pebble import Robot, run
from pebble.contract import APRILTAG_DATA, APRILTAG_LOCATIONS, WHEEL_ODOMETRY
from pebble.perception.camera_model import CameraModel
from pebble.perception.odom_follow import OdomFollower, OdomFollowSettings, pose_of
from pebble.perception.overlays import tag_data, tags_in
from pebble.perception.tags import Tag, TagGeometry, largest

POSE_AGE_S = 1.0  # odometry is published twice a second at rest

Power = Annotated[float, Meta(ge=0, le=1)]
Gain = Annotated[float, Meta(ge=0)]
Length = Annotated[float, Meta(ge=0)]


class Options(Struct):
    """The original's settings; a tag that is lost is searched for."""

    tag_id: Annotated[int, Meta(ge=0, title="Tag ID", extra={"arg": "marker-id"})] = 13
    tag_size_m: Annotated[
        float, Meta(ge=0.01, title="Tag Size (m)", extra={"arg": "marker-size", "required": True})
    ] = 0.25
    target_distance_m: Annotated[
        float, Meta(ge=0.05, title="Target Distance (m)", extra={"arg": "target-distance"})
    ] = 0.6
    distance_threshold_m: Annotated[
        Length, Meta(title="Distance Threshold (m)", extra={"arg": "distance-threshold"})
    ] = 0.05
    standoff_hysteresis_m: Annotated[Length, Meta(title="Standoff Hysteresis (m)")] = 0.03
    vision_forward_kp: Annotated[Gain, Meta(title="Vision Forward Kp")] = 2.0
    vision_reverse_kp: Annotated[Gain, Meta(title="Vision Reverse Kp")] = 2.0
    vision_forward_floor_distance_m: Annotated[Length, Meta(title="Vision Floor Dist (m)")] = 0.2
    forward_cone_deg: Annotated[float, Meta(ge=5, le=75, title="Forward Cone (deg)")] = 18.0
    forward_min_power: Annotated[Power, Meta(title="Forward Min Power")] = 0.8
    forward_max_power: Annotated[Power, Meta(title="Forward Max Power")] = 1.0
    control_rate_hz: Annotated[float, Meta(ge=1, title="Control Rate (Hz)", extra={"arg": "rate"})] = 10.0
    turn_power: Annotated[float, Meta(ge=0.05, le=1, title="Turn Power")] = 0.5
    turn_pulse_s: Annotated[float, Meta(ge=0.02, title="Turn Pulse (s)", extra={"arg": "turn-pulse"})] = 0.08
    turn_cooldown_s: Annotated[float, Meta(ge=0, title="Turn Cooldown (s)", extra={"arg": "turn-cooldown"})] = 0.18
    odom_goal_tolerance_m: Annotated[float, Meta(ge=0.01, title="Odom Goal Tolerance (m)")] = 0.06
    odom_heading_kp: Annotated[float, Meta(ge=0.1, title="Odom Heading Kp")] = 1.5
    odom_distance_kp: Annotated[float, Meta(ge=0.1, title="Odom Distance Kp")] = 1.4
    odom_min_drive_power: Annotated[Power, Meta(title="Odom Min Drive Power")] = 0.35
    odom_max_drive_power: Annotated[Power, Meta(title="Odom Max Drive Power")] = 0.9
    odom_brake_distance_m: Annotated[Length, Meta(title="Odom Brake Distance (m)")] = 0.25
    search_pause_s: Annotated[float, Meta(ge=0, title="Search Pause (s)", extra={"arg": "search-pause"})] = 0.35
    search_reverse_after_s: Annotated[
        float, Meta(ge=0, title="Search Reverse After (s)", extra={"arg": "search-reverse-after"})
    ] = 0.0
    lost_timeout_s: Annotated[float, Meta(ge=0, title="Lost Timeout (s)", extra={"arg": "lost-timeout"})] = 0.7
    tag_timeout_s: Annotated[float, Meta(ge=0.05, title="Tag Timeout (s)", extra={"arg": "tag-timeout"})] = 0.35
    min_goal_advance_m: Annotated[Length, Meta(title="Min Goal Advance (m)")] = 0.1
    goal_hold_s: Annotated[float, Meta(ge=0, title="Goal Hold (s)")] = 0.4


def main(robot: Robot, options: Options) -> None:
    camera = CameraModel.find([Path(__file__).parent, robot.config.folder])
    geometry = TagGeometry(options.tag_size_m, camera)
    follower = OdomFollower(convert(options, OdomFollowSettings, from_attributes=True))
    robot.publish_at_end(APRILTAG_DATA, lambda: tag_data(options.tag_id, None, (0, 0), time.time()))
    tags: list[Tag] = []
    tag: Tag | None = None
    seen, due = None, time.monotonic()
    while True:
        now = time.monotonic()
        newest = robot.latest(APRILTAG_LOCATIONS, options.tag_timeout_s)
        pose = pose_of(robot.latest(WHEEL_ODOMETRY, POSE_AGE_S))
        if newest is not seen:
            seen = newest
            tags = tags_in(newest, options.tag_id, geometry) if newest else []
            tag = largest(tags, options.tag_id)
            follower.see(now, tag and tag.place, pose)
        command = follower.step(now, pose)
        robot.drive(command.x, command.z)
        size = (newest.frame_width, newest.frame_height) if newest else (0, 0)
        robot.publish(APRILTAG_DATA, tag_data(options.tag_id, tag, size, time.time(), len(tags)))
        due = max(due + 1 / options.control_rate_hz, now)
        robot.sleep(due - time.monotonic())


if __name__ == "__main__":  # the scripts that it needs are named after their topics
    run(
        main,
        label="Follow a tag, also out of sight",
        summary="Drives to a printed tag, and on to where it was last while it is out of sight.",
        main_options=("tag_id", "target_distance_m", "tag_size_m"),
        needs={APRILTAG_LOCATIONS.metric: {}, WHEEL_ODOMETRY.metric: {"use_tune_state": False}},
    )
