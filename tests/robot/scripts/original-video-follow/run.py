"""A stand-in for the original's apriltag-follow, without any of its code: it follows the tag in the picture socket."""

from __future__ import annotations

import time

from tests.fakes.original_follow import Follow, follow_options
from tests.fakes.original_media import Robot, Tags, pictures


def main() -> None:
    options = follow_options().parse_args()
    robot, tags, script = Robot(options.config, "video-follow"), Tags(), Follow(options)
    robot.connect()
    due = 0.0
    for count, picture in enumerate(pictures(robot.video), 1):
        now = time.monotonic()
        robot.publish("outgoing/stand-in-pictures", {"count": count, "at": now})
        script.receive("apriltag-locations", tags.find(picture))
        if now >= due:
            due = now + 1 / options.control_rate_hz
            found, drive = script.step(now)
            robot.publish("outgoing/apriltag-data", found)
            robot.publish("incoming/drive-values", drive, qos=1)


if __name__ == "__main__":
    main()
