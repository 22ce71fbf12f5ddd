"""What scripts publish about the tags that the camera sees, compared with the true projection."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np

from pebble.extensions.lab.simulation.world.poses import RobotPose
from tests.robot.closed_loop.aims import Samples
from tests.robot.world_rig import TAG_SIZE_M, WorldRig
from tests.support import gone, until

LOCATIONS, OVERLAYS = "outgoing/apriltag-locations", "outgoing/video-overlays"
_HFOV_DEG, _LENS_M, _WIDTH, _HEIGHT = 54.3, 0.12, 640, 480
_TAG = {"x": 2.0, "y": 0.0, "z": 0.2}


def located(rig: WorldRig, seconds: float = 4.0) -> Samples:
    """``apriltag-locations`` in front of a tag."""
    rig.world.place(rig.name, 0.6, 0.15, -8.0)
    began = rig.run("apriltag-locations")
    assert until(lambda: _tags(rig, began), 15), "apriltag-locations sees no tag"
    first = time.monotonic()
    time.sleep(seconds)
    seen = _tags(rig, first)
    shapes = [one.json for one in rig.operator.on(OVERLAYS, first)]
    expected = projected(rig.world.pose(rig.name))
    ended = rig.end()
    assert until(lambda: len(_empty(rig, ended)) >= 2 or gone(rig.script()["pid"] or 0), 10)
    rig.idle()
    corners = [tag["corners_norm"] for one in seen for tag in one.json["detections"]]
    outlines = [[tag["corners_norm"] for tag in one.json["detections"]] for one in _tags(rig, began)]
    differing = [one for one in shapes if one["shapes"] not in outlines]
    return {
        "corners": [corner_error_px(tag, expected) for tag in corners],
        "locations rate": [(len(seen) - 1) / (seen[-1].at - seen[0].at)],
        "overlays": [float(len(differing))],
        "empty": [float(len(_empty(rig, ended)))],
    }


def projected(pose: RobotPose) -> np.ndarray[Any, Any]:
    """Where the tag's corners are in a picture taken from ``pose``: four points in pixels."""
    focal, half = _WIDTH / 2 / math.tan(math.radians(_HFOV_DEG) / 2), TAG_SIZE_M / 2
    ahead, left = math.cos(pose.heading), math.sin(pose.heading)
    points = []
    for side, up in ((1, 1), (-1, 1), (-1, -1), (1, -1)):
        dx, dy = _TAG["x"] - pose.x, _TAG["y"] + side * half - pose.y
        depth, leftwards = dx * ahead + dy * left, dy * ahead - dx * left
        points.append(
            (_WIDTH / 2 - focal * leftwards / depth, _HEIGHT / 2 - focal * (_TAG["z"] + up * half - _LENS_M) / depth)
        )
    return np.array(points)


def corner_error_px(corners: list[list[float]], expected: np.ndarray[Any, Any]) -> float:
    """The largest distance of a corner from the nearest expected one; the order of corners is the finder's own."""
    found = np.array(corners) * (_WIDTH, _HEIGHT)
    return float(np.max(np.min(np.linalg.norm(found[:, None] - expected[None], axis=2), axis=1)))


def crashed_dependency(rig: WorldRig) -> Samples:
    """``needy`` needs ``crash``, which ends with code 3 after half a second."""
    began = rig.run("needy")
    assert until(lambda: any(seen.json["running"] for seen in rig.operator.on("outgoing/autonomy-status", began)), 10)
    pids = {one["pid"] for seen in rig.operator.on("outgoing/autonomy-status", began)
            for one in (seen.json, *seen.json["dependencies"])} - {None}  # fmt: skip
    until(lambda: rig.fresh_status(began) and rig.script()["error"], 10)
    error = rig.script().get("error") or ""
    until(lambda: all(map(gone, pids)), 3)
    time.sleep(1.0)  # a restart would be seen
    alive = [pid for pid in pids if not gone(pid)]
    again = rig.script()["running"]
    return {"exit code": [float("crash" in error and "3" in error)], "alive": [float(len(alive) + again)]}


def _tags(rig: WorldRig, since: float) -> list[Any]:
    return [seen for seen in rig.operator.on(LOCATIONS, since) if seen.json["detections"]]


def _empty(rig: WorldRig, since: float) -> list[Any]:
    locations = [seen for seen in rig.operator.on(LOCATIONS, since) if not seen.json["detections"]]
    return locations[:1] + [seen for seen in rig.operator.on(OVERLAYS, since) if not seen.json["shapes"]][:1]
