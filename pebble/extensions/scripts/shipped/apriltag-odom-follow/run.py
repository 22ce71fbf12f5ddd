"""Follows an AprilTag that another script finds, and drives on by odometry while the tag is out of sight."""

import time
from pathlib import Path

from pebble import Robot, run
from pebble.contract import APRILTAG_DATA, APRILTAG_LOCATIONS, WHEEL_ODOMETRY
from pebble.extensions.scripts.perception.camera_model import CameraModel
from pebble.extensions.scripts.perception.follow import FollowSettings
from pebble.extensions.scripts.perception.odom_follow import OdomFollower, pose_of
from pebble.extensions.scripts.perception.overlays import tag_data, tags_in
from pebble.extensions.scripts.perception.tags import Tag, TagGeometry, largest

POSE_AGE_S = 1.0  # odometry is published twice a second at rest


def main(robot: Robot, options: FollowSettings) -> None:
    camera = CameraModel.find([Path(__file__).parent, robot.config.folder])
    geometry = TagGeometry(options.tag_size_m, camera)
    follower = OdomFollower(options)
    robot.publish_at_end(APRILTAG_DATA, lambda: tag_data(options.tag_id, None, (0, 0), time.time()))
    tags: list[Tag] = []
    tag: Tag | None = None
    seen, due = None, time.monotonic()
    while True:
        now = time.monotonic()
        locations = robot.latest(APRILTAG_LOCATIONS, options.tag_timeout_s)
        pose = pose_of(robot.latest(WHEEL_ODOMETRY, POSE_AGE_S))
        if locations is not seen:  # of another picture
            seen = locations
            tags = tags_in(locations, options.tag_id, geometry) if locations else []
            tag = largest(tags, options.tag_id)
            follower.see(now, tag and tag.place, pose)
        command = follower.step(now, pose)
        robot.drive(command.x, command.z)
        size = (locations.frame_width, locations.frame_height) if locations else (0, 0)
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
