"""A stand-in for the original's apriltag-locations, without any of its code: ``python … --config FILE``.

It reads the picture socket, and publishes the tags it sees, also when it sees none, at most ``--rate`` times a second.
"""

from __future__ import annotations

import argparse
import time

from tests.fakes.original_media import Robot, Tags, pictures


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--config", required=True)
    parser.add_argument("--rate", type=float, default=12.0)
    options = parser.parse_args()
    robot, tags = Robot(options.config, "locations"), Tags()
    robot.connect()
    due = 0.0
    for count, picture in enumerate(pictures(robot.video), 1):
        now = time.monotonic()
        robot.publish("outgoing/stand-in-pictures", {"count": count, "at": now})
        if now >= due:
            due = now + 1 / options.rate
            found = tags.find(picture)
            robot.publish("outgoing/apriltag-locations", found)
            robot.publish("outgoing/video-overlays", {"source": "stand-in", "overlays": []})


if __name__ == "__main__":
    main()
