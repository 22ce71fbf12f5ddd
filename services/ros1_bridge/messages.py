"""The messages of ROS 1 that are sent or read here, without ROS: bytes in, bytes out."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import Any, NamedTuple


class Form(NamedTuple):
    """A message type, with the digest of its definition, which nodes compare."""

    kind: str
    md5: str


TWIST = Form("geometry_msgs/Twist", "9f195f881246fdfa2798d1d3eebca84a")
BOOL = Form("std_msgs/Bool", "8b94c1b53db61fb6aed406028ad6332a")
GOAL_ID = Form("actionlib_msgs/GoalID", "302881f31927c1df708a2dbab0e80ee8")
ODOMETRY = Form("nav_msgs/Odometry", "cd5e73d190d741a2f92e81eda573aca7")
DIAGNOSTICS = Form("diagnostic_msgs/DiagnosticArray", "60810da900de1dd6ddd437c3503511da")
POSE = Form("geometry_msgs/PoseStamped", "d3812c3cbc69362b77dc0b19b345f8f5")
GOAL_STATUS = Form("actionlib_msgs/GoalStatusArray", "8b2b82f13216d0a8ea88bd3af735e619")
PATH = Form("nav_msgs/Path", "6227e2b7e9cce15051f669a5e197bbf7")

CANCEL_ALL = struct.pack("<III", 0, 0, 0)  # a GoalID with the stamp 0 and no id
_TWIST = struct.Struct("<6d").pack

Numbers = tuple[float, ...]


class Header(NamedTuple):
    """The time and frame of a measurement; ``stamp``: seconds, 0 if the sender has none."""

    stamp: float
    frame: str


class Odometry(NamedTuple):
    """The pose and speed of the base; ``quaternion``: x, y, z, w."""

    header: Header
    child_frame: str
    position: Numbers
    quaternion: Numbers
    linear: float  # metres a second ahead
    angular: float  # radians a second to the left


class Pose(NamedTuple):
    """A place and a direction."""

    header: Header
    position: Numbers
    quaternion: Numbers


class Route(NamedTuple):
    """The points of a plan."""

    header: Header
    points: list[Numbers]


class Goal(NamedTuple):
    """The result of a goal."""

    id: str
    code: int
    text: str


class Health(NamedTuple):
    """The diagnostics of one part of a base."""

    level: int
    name: str
    message: str
    values: dict[str, str]


def twist(linear: float, angular: float) -> bytes:
    """Return a Twist: forward speed in m/s, turn rate in rad/s to the left. Raises ValueError if one is not finite."""
    if not (math.isfinite(linear) and math.isfinite(angular)):
        raise ValueError("a speed is not a finite number")
    return _TWIST(linear, 0.0, 0.0, 0.0, 0.0, angular)


def boolean(value: bool) -> bytes:
    return b"\x01" if value else b"\x00"


class _Reader:
    """A reader of consecutive fields. Raises struct.error if the message ends too early."""

    def __init__(self, body: bytes) -> None:
        self._body, self._at = body, 0

    def get(self, form: str) -> tuple[Any, ...]:
        values = struct.unpack_from("<" + form, self._body, self._at)
        self._at += struct.calcsize("<" + form)
        return values

    def skip(self, size: int) -> None:
        if self._at + size > len(self._body):
            raise struct.error("the message ends too early")
        self._at += size

    def count(self) -> int:
        number: int = self.get("I")[0]
        return number

    def text(self) -> str:
        size, begin = self.count(), self._at
        self.skip(size)
        return self._body[begin : self._at].decode("utf-8", "replace")

    def header(self) -> Header:
        _, seconds, nanoseconds = self.get("III")
        return Header(seconds + nanoseconds / 1e9, self.text())


def odometry(body: bytes) -> Odometry:
    reader = _Reader(body)
    header, child = reader.header(), reader.text()
    pose = reader.get("7d")
    reader.skip(36 * 8)  # the covariance of the pose
    speeds = reader.get("6d")
    return Odometry(header, child, pose[:3], pose[3:], speeds[0], speeds[5])


def pose(body: bytes) -> Pose:
    reader = _Reader(body)
    header, values = reader.header(), reader.get("7d")
    return Pose(header, values[:3], values[3:])


def route(body: bytes) -> Route:
    reader = _Reader(body)
    header, points = reader.header(), []
    for _ in range(reader.count()):
        reader.header()  # of the point, not used
        points.append(reader.get("7d")[:3])
    return Route(header, points)


def goals(body: bytes) -> tuple[Header, list[Goal]]:
    """Return the goals of a planner, with what has become of each: the message of GOAL_STATUS."""
    reader = _Reader(body)
    header, results = reader.header(), []
    for _ in range(reader.count()):
        reader.skip(8)  # when the goal was set
        name, (code,), text = reader.text(), reader.get("B"), reader.text()
        results.append(Goal(name, code, text))
    return header, results


def diagnostics(body: bytes) -> tuple[Header, list[Health]]:
    """Return the header of a DiagnosticArray, and the health of each part that it lists."""
    reader = _Reader(body)
    header, parts = reader.header(), []
    for _ in range(reader.count()):
        (level,) = reader.get("b")
        name, message, _hardware = reader.text(), reader.text(), reader.text()
        pairs = [(reader.text(), reader.text()) for _ in range(reader.count())]
        parts.append(Health(level, name, message, dict(pairs)))
    return header, parts


def yaw(quaternion: Sequence[float]) -> float:
    """Return the heading: the turn about the vertical axis, in radians to the left."""
    x, y, z, w = quaternion
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
