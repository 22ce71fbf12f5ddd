"""A controller that follows a tag and, while it is out of sight, drives by odometry to its last place."""

import math
from typing import Any, NamedTuple

from msgspec.structs import replace

from pebble.contract.payloads import WheelOdometry
from pebble.extensions.scripts.perception.follow import Command, Follower, FollowSettings
from pebble.extensions.scripts.perception.tags import Place

_BLIND_S = 6.0  # so long after the tag was seen the robot drives by odometry, at most
_SLOW_RAD = math.radians(40.0)  # the farther off the goal's direction beyond this, the slower
_LEAST_SHARE = 0.2
_TURN_POWER = 0.6


class Pose(NamedTuple):
    """A pose in the odometry's frame: metres, and radians, counter-clockwise positive."""

    x_m: float
    y_m: float
    heading_rad: float


def pose_of(odometry: WheelOdometry | None) -> Pose | None:
    """Return the pose in a payload of any producer, in metres or millimetres; None if it has none."""
    if odometry is None:
        return None
    value = odometry.value
    x, y = _number(value, "x_mm", "x"), _number(value, "y_mm", "y")
    heading, degrees = _number(value, "heading_rad", "theta_rad", "heading"), _number(value, "heading_deg", "theta_deg")
    if heading is None and degrees is not None:
        heading = math.radians(degrees)
    if x is None or y is None or heading is None:
        return None
    metres = 1.0 if odometry.unit.lower() in ("m", "meter", "meters") else 0.001
    return Pose(x * metres, y * metres, math.remainder(heading, math.tau))


def _number(value: dict[str, Any], *names: str) -> float | None:
    """Return the first field with one of these names; None if there is none, or it is no finite number."""
    number = next((value[name] for name in names if value.get(name) is not None), None)
    if not isinstance(number, int | float) or not math.isfinite(number):
        return None
    return float(number)


class OdomFollower:
    """A follower of a tag in and out of sight. Call ``see`` for every picture, and ``step`` at about 10 Hz."""

    def __init__(self, settings: FollowSettings) -> None:
        self.settings = settings
        self._vision = Follower(replace(settings, tag_timeout_s=0.0))  # how old a place may be is decided here
        self._place: Place | None = None  # of the tag in the newest picture
        self._goal: tuple[float, float] | None = None  # x and y to which the robot drives while the tag is out of sight
        self._seen_at = self._planned_at = self._ended_at = float("-inf")  # ended: a goal was reached, or took too long

    def see(self, now: float, place: Place | None, pose: Pose | None) -> None:
        """Note the tag's place (None: not in the picture), and the pose at that time, if known."""
        self._place, self._seen_at = place, now
        if place is not None:
            self._goal = None if pose is None else self._plan(place, pose)
            self._planned_at = now

    def step(self, now: float, pose: Pose | None) -> Command:
        """Return the command: by the camera if the tag is in sight, else by odometry to its place, else to find it."""
        place = self._place if now - self._seen_at <= self.settings.tag_timeout_s else None
        vision = self._vision.step(now, place)  # it waits and searches on, even while odometry leads
        if place is not None:
            return vision
        if self._goal is not None and pose is not None:
            blind = self._to_goal(now, self._goal, pose)
            if blind is not None:
                return blind
        if now - self._ended_at < self.settings.goal_hold_s:
            return Command(reason="goal reached")
        return vision

    def _plan(self, place: Place, pose: Pose) -> tuple[float, float] | None:
        """Return the point on the way to the tag that has the wanted distance from it; None if it is near."""
        settings = self.settings
        advance = place.distance_m - settings.target_distance_m
        if advance <= max(settings.distance_threshold_m, settings.min_goal_advance_m):
            return None
        bearing = pose.heading_rad - place.angle_rad
        return pose.x_m + advance * math.cos(bearing), pose.y_m + advance * math.sin(bearing)

    def _to_goal(self, now: float, goal: tuple[float, float], pose: Pose) -> Command | None:
        """Return the command that leads to the goal; None if the goal is reached, or its time is over."""
        settings = self.settings
        dx, dy = goal[0] - pose.x_m, goal[1] - pose.y_m
        distance = math.hypot(dx, dy)
        if distance <= settings.odom_goal_tolerance_m or now - self._planned_at > _BLIND_S:
            self._goal, self._ended_at = None, now
            return None
        off_rad = math.remainder(math.atan2(dy, dx) - pose.heading_rad, math.tau)  # > 0: to the left
        steering = max(-1.0, min(1.0, settings.odom_heading_kp * off_rad / (math.pi / 2)))
        least_power = settings.odom_min_drive_power if distance >= settings.odom_brake_distance_m else 0.0
        power = min(settings.odom_max_drive_power, max(least_power, settings.odom_distance_kp * distance))
        if abs(off_rad) > _SLOW_RAD:
            power *= max(_LEAST_SHARE, 1.0 - (abs(off_rad) - _SLOW_RAD) / (math.pi - _SLOW_RAD))
        x = -steering * _TURN_POWER
        return Command(x, min(power, 1.0 - abs(x)), "odometry")
