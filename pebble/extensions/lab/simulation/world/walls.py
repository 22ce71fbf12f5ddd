"""The bodies of robots on the floor: round, solid, stopped by walls and by each other.

A robot that drives against something stays where it touches it. Its wheels slip, so they and their hall sensors turn as
driven. It still turns on the spot and drives away. Nothing is pushed, slides along a wall, or bounces.
"""

from __future__ import annotations

import math
import threading
from functools import partial

from pebble.extensions.lab.simulation.motion import Pose, RobotMotion, Wheels
from pebble.extensions.lab.simulation.world.world_file import World

_HALVINGS = 12  # of a move that is not free, to find the contact: of 8 mm, 2 µm are left
_ROUNDING_MM = 1e-6


class Floor:
    """The poses of all robots of a world. Thread-safe, because each robot's motion has a thread of its own."""

    def __init__(self, world: World) -> None:
        self._lock = threading.Lock()
        self._walls = world.all_walls
        self._radius_mm = {name: place.radius_m * 1000 for name, place in world.robots.items()}
        self._poses = {name: start_pose(world, name) for name in world.robots}

    def move(self, name: str, start: Pose, end: Pose) -> Pose:
        """Move a robot as far as the way is free; return its pose then, with the heading of ``end``."""
        with self._lock:
            start_clearance_mm = self._clearance_mm(name, start.x_mm, start.y_mm)
            is_free = self._free(name, start, end, 1.0, start_clearance_mm)  # 1.0: the whole move
            part = 1.0 if is_free else self._free_part(name, start, end, start_clearance_mm)
            x_mm, y_mm = _between(start, end, part)
            self._poses[name] = Pose(x_mm, y_mm, end.heading_rad)
            return self._poses[name]

    def _free_part(self, name: str, start: Pose, end: Pose, start_clearance_mm: float) -> float:
        """Return how much of the move is free, 0 to 1, by halving. ``start_clearance_mm``: at its start, see _free."""
        free, blocked = 0.0, 1.0
        for _ in range(_HALVINGS):
            middle = (free + blocked) / 2
            if self._free(name, start, end, middle, start_clearance_mm):
                free = middle
            else:
                blocked = middle
        return free

    def _free(self, name: str, start: Pose, end: Pose, part: float, start_clearance_mm: float) -> bool:
        """True if the robot overlaps nothing after this part of the move, or not more than at its start."""
        clearance_mm = self._clearance_mm(name, *_between(start, end, part))
        return clearance_mm >= min(0.0, start_clearance_mm) - _ROUNDING_MM

    def _clearance_mm(self, name: str, x_mm: float, y_mm: float) -> float:
        """Return the distance from the robot's body to the nearest obstacle; negative if they overlap."""
        radius_mm = self._radius_mm[name]
        walls = (wall.distance(x_mm / 1000, y_mm / 1000) * 1000 - radius_mm for wall in self._walls)
        others = (
            math.hypot(x_mm - pose.x_mm, y_mm - pose.y_mm) - radius_mm - self._radius_mm[other]
            for other, pose in self._poses.items()
            if other != name
        )
        return min((*walls, *others), default=math.inf)


def start_pose(world: World, name: str) -> Pose:
    place = world.robots[name]
    return Pose(place.x * 1000, place.y * 1000, math.remainder(math.radians(place.heading_deg), math.tau))


def motion_of(world: World, name: str, floor: Floor) -> RobotMotion:
    """Return the motion of a robot, on its wheels, from the place where it starts."""
    place = world.robots[name]
    wheels = Wheels(place.left_wheel_mm, place.right_wheel_mm, place.track_mm)
    return RobotMotion(start_pose(world, name), partial(floor.move, name), wheels)


def _between(start: Pose, end: Pose, part: float) -> tuple[float, float]:
    return start.x_mm + part * (end.x_mm - start.x_mm), start.y_mm + part * (end.y_mm - start.y_mm)
