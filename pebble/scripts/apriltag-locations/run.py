"""Publishes which AprilTags the camera sees, and outlines them in the operators' picture."""

import time
from pathlib import Path
from typing import Annotated

from msgspec import Meta, Struct

from pebble import Robot, run
from pebble.contract import APRILTAG_LOCATIONS, VIDEO_OVERLAYS
from pebble.contract.renaming import renamed
from pebble.perception.camera_model import CameraModel
from pebble.perception.overlays import locations, overlays
from pebble.perception.rate import Rate
from pebble.perception.tags import FAMILY, TagFinder, TagOrder
from pebble.runtime.rate_limit import RateLimitedLog

SOURCE = Path(__file__).parent.name


class Options(Struct):
    """Pictures come as the robot captures them: width, height and fps are accepted for the sake of older settings."""

    width: Annotated[int, Meta(ge=160, title="Frame Width")] = 1280
    height: Annotated[int, Meta(ge=120, title="Frame Height")] = 720
    fps: Annotated[float, Meta(ge=1, title="Frame FPS")] = 15.0
    control_rate_hz: Annotated[float, Meta(ge=1, title="Publish Rate (Hz)", extra={"arg": "rate"})] = 12.0
    marker_dictionary: Annotated[str, Meta(title="Tag Dictionary")] = FAMILY
    locations_topic: Annotated[str, Meta(title="Locations Topic")] = ""
    overlays_topic: Annotated[str, Meta(title="Overlays Topic")] = ""


def main(robot: Robot, options: Options) -> None:
    found = renamed(APRILTAG_LOCATIONS, options.locations_topic, robot.config.base)
    drawn = renamed(VIDEO_OVERLAYS, options.overlays_topic, robot.config.base)
    camera = CameraModel.find([Path(__file__).parent, robot.config.folder])
    finder, rate, size = (
        TagFinder(camera=camera, family=options.marker_dictionary),
        Rate(options.control_rate_hz),
        (0, 0),
    )
    order, log = TagOrder(), RateLimitedLog(robot.log, period_s=10.0)
    robot.publish_at_end(found, lambda: locations(SOURCE, [], size, time.time()))
    robot.publish_at_end(drawn, lambda: overlays(SOURCE, [], size, time.time()))
    for picture in robot.camera():
        if rate.due(time.monotonic()):
            size = (picture.shape[1], picture.shape[0])
            tags, now = order.sort(finder.find(picture), time.monotonic()), time.time()
            for remark in order.remarks:
                log.warning("tags", "%s", remark)
            robot.publish(found, locations(SOURCE, tags, size, now))
            robot.publish(drawn, overlays(SOURCE, tags, size, now))


if __name__ == "__main__":
    run(
        main,
        label="Look for tags",
        summary="Outlines the printed tags that the camera sees, and moves nothing.",
        main_options=("control_rate_hz", "marker_dictionary"),
    )
