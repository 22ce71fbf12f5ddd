"""Publishes which AprilTags the camera sees, and outlines them in the operators' picture."""

import time
from pathlib import Path
from typing import Annotated

from msgspec import Meta, Struct

from pebble import Robot, run
from pebble.contract import APRILTAG_LOCATIONS, VIDEO_OVERLAYS
from pebble.extensions.scripts.perception.camera_model import CameraModel
from pebble.extensions.scripts.perception.overlays import locations, overlays
from pebble.extensions.scripts.perception.rate import Rate
from pebble.extensions.scripts.perception.tags import FAMILY, TagFinder

SOURCE = Path(__file__).parent.name


class Options(Struct):
    control_rate_hz: Annotated[float, Meta(ge=1, title="Publish Rate (Hz)", extra={"arg": "rate"})] = 12.0
    marker_dictionary: Annotated[str, Meta(title="Tag Dictionary")] = FAMILY


def main(robot: Robot, options: Options) -> None:
    camera = CameraModel.find([Path(__file__).parent, robot.config.folder])
    finder, rate = TagFinder(camera=camera, family=options.marker_dictionary), Rate(options.control_rate_hz)
    size = (0, 0)
    robot.publish_at_end(APRILTAG_LOCATIONS, lambda: locations(SOURCE, [], size, time.time()))
    robot.publish_at_end(VIDEO_OVERLAYS, lambda: overlays(SOURCE, [], size, time.time()))
    for picture in robot.camera():
        if rate.due(time.monotonic()):
            size = (picture.shape[1], picture.shape[0])
            tags, now = finder.find(picture), time.time()
            robot.publish(APRILTAG_LOCATIONS, locations(SOURCE, tags, size, now))
            robot.publish(VIDEO_OVERLAYS, overlays(SOURCE, tags, size, now))


if __name__ == "__main__":
    run(
        main,
        label="Look for tags",
        summary="Outlines the printed tags that the camera sees, and moves nothing.",
        main_options=("control_rate_hz", "marker_dictionary"),
        drives=False,
    )
