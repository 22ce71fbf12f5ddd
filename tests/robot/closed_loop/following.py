"""A script that follows a tag on a wall, compared with the true poses."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from itertools import pairwise

from tests.robot.closed_loop.aims import Samples
from tests.robot.world_rig import FOLLOW, WorldRig

TARGET_M, WITHIN_M, ORIGINAL_WITHIN_M = 0.6, 0.05, 0.08
_LONGEST_S, _STEP_S = 30.0, 0.05


@dataclass(frozen=True, slots=True)
class Start:
    """Where the robot stands: metres from the tag, degrees beside the tag's front, degrees from looking at it."""

    distance: float
    beside: float
    off: float

    @property
    def pose(self) -> tuple[float, float, float]:
        """x, y and heading in degrees in the room, whose tag is at (2, 0) and looks to the robot."""
        angle = math.radians(self.beside)
        return 2.0 - self.distance * math.cos(angle), self.distance * math.sin(angle), self.off - self.beside


def followed(rig: WorldRig, start: Start, stay_s: float = 5.0) -> Samples:
    """Follow the tag from ``start`` until the robot has stayed at its distance for ``stay_s``."""
    rig.world.place(rig.name, *start.pose)
    already = len(rig.timings())
    began = rig.run("timed-follow", FOLLOW)
    took = _arrival(rig, stay_s, WITHIN_M) - began
    distance, bearing = rig.world.tag_from(rig.name)
    statuses = [seen.at for seen in rig.operator.on("outgoing/autonomy-status", began) if seen.json["running"]]
    tags = [seen.at for seen in rig.operator.on("outgoing/apriltag-data", began)]
    running, first_tag = ((found[0] if found else math.inf) - began for found in (statuses, tags))
    rig.idle()
    timings = rig.timings()[already:]
    spans = [later - earlier for (_, earlier), (_, later) in pairwise(timings)]
    return {
        "running": [running],
        "first tag": [first_tag],
        "settled": [took],
        "distance": [distance],
        "bearing": [math.degrees(bearing)],
        "latency": [1000 * (published - captured) for captured, published in timings],
        "command rate": [len(spans) / sum(spans)] if spans else [],
    }


def _arrival(rig: WorldRig, stay_s: float, within_m: float) -> float:
    """When the robot began to stay at its distance for ``stay_s``; infinite if it does not within 30 s."""
    since, end = math.inf, time.monotonic() + _LONGEST_S
    while time.monotonic() < end and time.monotonic() - since < stay_s:
        time.sleep(_STEP_S)
        distance, _ = rig.world.tag_from(rig.name)
        since = min(since, time.monotonic()) if abs(distance - TARGET_M) <= within_m else math.inf
    return since
