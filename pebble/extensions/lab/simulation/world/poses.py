"""The poses of a robot in the last second; those in between are interpolated."""

import math
from bisect import bisect_right
from collections.abc import Sequence
from typing import NamedTuple


class RobotPose(NamedTuple):
    """A pose in metres and radians, counter-clockwise."""

    x: float
    y: float
    heading: float


class Sample(NamedTuple):
    """A pose, with its time in monotonic nanoseconds."""

    ns: int
    pose: RobotPose


class Track:
    """The samples of a robot, oldest first; at least one."""

    def __init__(self, samples: Sequence[Sample]) -> None:
        self.samples = samples

    @property
    def newest(self) -> Sample:
        return self.samples[-1]

    def at(self, ns: int) -> RobotPose:
        """Return the pose at ``ns``, interpolated; for a time outside of the samples the oldest or newest."""
        next_index = bisect_right(self.samples, ns, key=lambda sample: sample.ns)
        if next_index == 0:
            return self.samples[0].pose
        if next_index == len(self.samples):
            return self.newest.pose
        (start, earlier), (end, later) = self.samples[next_index - 1], self.samples[next_index]
        part = (ns - start) / (end - start)
        turn = math.remainder(later.heading - earlier.heading, math.tau)
        return RobotPose(
            earlier.x + part * (later.x - earlier.x),
            earlier.y + part * (later.y - earlier.y),
            earlier.heading + part * turn,
        )
