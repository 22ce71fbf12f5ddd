"""Follows an AprilTag with the camera alone, and holds a distance from it."""

import time
from pathlib import Path
from typing import Annotated

from msgspec import Meta, Struct, convert

from pebble import Robot, run
from pebble.contract import APRILTAG_DATA, VIDEO_OVERLAYS
from pebble.extensions.scripts.perception.camera_model import HFOV_DEG, CameraModel
from pebble.extensions.scripts.perception.follow import Follower, FollowSettings
from pebble.extensions.scripts.perception.overlays import overlays, tag_data
from pebble.extensions.scripts.perception.rate import Rate
from pebble.extensions.scripts.perception.tags import FAMILY, TagFinder, largest

SOURCE = Path(__file__).parent.name

Power = Annotated[float, Meta(ge=0, le=1)]


class Options(Struct, kw_only=True):
    tag_id: Annotated[int, Meta(ge=0, title="Tag ID", extra={"arg": "marker-id"})] = 13
    tag_size_m: Annotated[
        float, Meta(ge=0.01, le=5, title="Tag Size (m)", extra={"arg": "marker-size", "required": True})
    ] = 0.25
    target_distance_m: Annotated[
        float, Meta(ge=0.05, le=20, title="Target Distance (m)", extra={"arg": "target-distance"})
    ] = 0.6
    distance_threshold_m: Annotated[
        float, Meta(ge=0, le=5, title="Distance Threshold (m)", extra={"arg": "distance-threshold"})
    ] = 0.05
    forward_cone_deg: Annotated[float, Meta(ge=5, le=75, title="Forward Cone (deg)")] = 18.0
    forward_min_power: Annotated[Power, Meta(title="Forward Min Power")] = 0.8
    forward_max_power: Annotated[Power, Meta(title="Forward Max Power")] = 1.0
    control_rate_hz: Annotated[float, Meta(ge=1, le=50, title="Control Rate (Hz)", extra={"arg": "rate"})] = 10.0
    turn_power: Annotated[float, Meta(ge=0.05, le=1, title="Turn Power")] = 0.5
    turn_pulse_s: Annotated[float, Meta(ge=0.02, le=5, title="Turn Pulse (s)", extra={"arg": "turn-pulse"})] = 0.08
    turn_cooldown_s: Annotated[float, Meta(ge=0, le=5, title="Turn Cooldown (s)", extra={"arg": "turn-cooldown"})] = (
        0.18
    )
    search_pause_s: Annotated[float, Meta(ge=0, le=60, title="Search Pause (s)", extra={"arg": "search-pause"})] = 0.35
    search_reverse_after_s: Annotated[
        float, Meta(ge=0, title="Search Reverse After (s)", extra={"arg": "search-reverse-after"})
    ] = 0.0
    lost_timeout_s: Annotated[float, Meta(ge=0, le=60, title="Lost Timeout (s)", extra={"arg": "lost-timeout"})] = 0.7
    marker_dictionary: Annotated[str, Meta(title="Tag Dictionary")] = FAMILY
    hfov_deg: Annotated[float, Meta(ge=20, le=160, title="Field of View (deg), without a calibration")] = HFOV_DEG


def main(robot: Robot, options: Options) -> None:
    camera = CameraModel.find([Path(__file__).parent, robot.config.folder], options.hfov_deg)
    finder = TagFinder(options.tag_size_m, camera, options.marker_dictionary)
    follower = Follower(convert(options, FollowSettings, from_attributes=True))
    rate, size = Rate(options.control_rate_hz), (0, 0)
    robot.publish_at_end(APRILTAG_DATA, lambda: tag_data(options.tag_id, None, size, time.time()))
    robot.publish_at_end(VIDEO_OVERLAYS, lambda: overlays(SOURCE, [], size, time.time()))
    for picture in robot.camera():
        if not rate.due(time.monotonic()):
            continue
        size = (picture.shape[1], picture.shape[0])
        tags = [tag for tag in finder.find(picture) if tag.id == options.tag_id]
        tag = largest(tags, options.tag_id)
        command = follower.step(time.monotonic(), tag and tag.place)
        robot.drive(command.x, command.z)
        robot.publish(APRILTAG_DATA, tag_data(options.tag_id, tag, size, time.time(), len(tags)))
        robot.publish(VIDEO_OVERLAYS, overlays(SOURCE, [tag] if tag else [], size, time.time()))


if __name__ == "__main__":
    run(
        main,
        label="Follow a tag",
        summary="Drives towards a printed tag and stays in front of it.",
        main_options=("tag_id", "target_distance_m", "tag_size_m"),
    )
