"""A robot with a camera in a simulated world follows a tag: firmware, renderer, finder and controller on one clock."""

from __future__ import annotations

import math
import random
import re
from typing import Any, NamedTuple

from pebble.contract.payloads import MotorPower, TouchValues
from pebble.extensions.lab.simulation.world.lockstep import LockstepWorld
from pebble.extensions.lab.simulation.world.world_file import parse_world
from pebble.extensions.scripts.perception.follow import Command, Follower, FollowSettings
from pebble.extensions.scripts.perception.odom_follow import OdomFollower, Pose
from pebble.extensions.scripts.perception.odometry import Odometry, OdometrySettings
from pebble.extensions.scripts.perception.rate import Rate
from pebble.extensions.scripts.perception.tags import TagFinder
from pebble.services.serial_mcu_bridge.text.goob_base import mix

TAG = 13
TARGET_M = 0.6
WITHIN_M = 0.03
QUIET_S = 3.0  # it counts as arrived if it stays so long
_touch = re.compile(rb"T a0=(\d+) a1=(\d+) a2=(\d+)").fullmatch


class Result(NamedTuple):
    """``arrived_s`` None: it was not within 3 cm of the wanted distance to the end."""

    arrived_s: float | None
    distance_m: float
    bearing_deg: float
    path: tuple[tuple[float, float, float], ...]  # all poses, twice a second


class FollowRig:
    """A tag at the origin that looks along x, and a start drawn by ``seed``: 1 to 2.8 m away, up to 69 degrees off."""

    def __init__(
        self, seed: int, *, by_odometry: bool = False, hidden: tuple[float, float] = (0.0, 0.0), **camera: Any
    ) -> None:
        chosen = random.Random(seed)
        distance, aside = chosen.uniform(1.0, 2.8), math.radians(chosen.uniform(-40, 40))
        x, y = distance * math.cos(aside), distance * math.sin(aside)
        heading = math.pi + aside + math.radians(chosen.uniform(-69, 69))
        place = {"x": x, "y": y, "heading_deg": math.degrees(heading)}
        tags = [{"id": TAG, "x": 0.0, "y": 0.0}]
        self.world = LockstepWorld(parse_world({"tags": tags, "camera": camera, "robots": {"goob": place}}))
        self.robot = self.world.robots["goob"]
        self._finder = TagFinder()
        self._hidden = hidden
        self._rate = Rate(10.0)
        self._odometry = Odometry(OdometrySettings(), 0.0)
        self._received = b""
        self._vision = None if by_odometry else Follower(FollowSettings())
        self._both = OdomFollower(FollowSettings()) if by_odometry else None
        self.reasons: list[str] = []

    def run(self, seconds: float) -> Result:
        path, arrived = [], None
        while self.world.now() < seconds:
            self.world.step()
            now = self.world.now()
            self._read_wheels(now)
            command = self._see(now)
            if command is not None:
                self.reasons.append(command.reason)
                left, right = mix(command.x, command.z)
                self._odometry.power(MotorPower(left=left, right=right), now)
                self.robot.drive(command.x, command.z)
            if len(path) < now * 2:
                pose = self.robot.pose
                path.append((pose.x, pose.y, pose.heading))
            away = abs(self.distance - TARGET_M) > WITHIN_M or abs(self.bearing) > math.radians(10)
            arrived = None if away else (now if arrived is None else arrived)
            if arrived is not None and now - arrived > QUIET_S:
                break
        return Result(arrived, self.distance, math.degrees(self.bearing), tuple(path))

    @property
    def distance(self) -> float:
        pose = self.robot.pose
        return math.hypot(pose.x, pose.y)

    @property
    def bearing(self) -> float:
        pose = self.robot.pose
        return math.remainder(math.atan2(-pose.y, -pose.x) - pose.heading, math.tau)

    def _see(self, now: float) -> Command | None:
        """Take a new picture, if there is one, and command ten times a second."""
        picture = self.robot.picture()
        if picture is None:
            return None
        due = self._rate.due(now)
        if not due and self._vision is not None:
            return None
        tags = [] if self._hidden[0] <= now < self._hidden[1] else self._finder.find(picture.pixels)
        place = next((tag.place for tag in tags if tag.id == TAG), None)
        if self._vision is not None:
            return self._vision.step(now, place)
        assert self._both is not None
        self._both.see(now, place, self._pose)
        return self._both.step(now, self._pose) if due else None

    @property
    def _pose(self) -> Pose:
        pose = self._odometry.pose
        return Pose(pose.x_mm / 1000, pose.y_mm / 1000, pose.heading_rad)

    def _read_wheels(self, now: float) -> None:
        *lines, self._received = (self._received + self.robot.read()).split(b"\n")
        for found in filter(None, map(_touch, (line.strip() for line in lines))):
            a0, a1, a2 = map(int, found.groups())
            self._odometry.touch(TouchValues(a0=a0, a1=a1, a2=a2), now)


CAMERAS: dict[str, dict[str, Any]] = {
    "ideal": {},
    "100 ms late": {"latency_ms": 100},
    "200 ms late": {"latency_ms": 200},
    "blurred and JPEG": {"motion_blur_ms": 30, "jpeg_quality": 20},
    "all of it": {"latency_ms": 150, "motion_blur_ms": 30, "jpeg_quality": 20},
}
