"""Telemetry of a base: its odometry, planner, diagnostics and battery, as in the original Pebble's bridge."""

from __future__ import annotations

import logging
import math
import struct
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from pebble import contract as c
from pebble.contract import Channel
from pebble.runtime.rate_limit import RateLimitedLog
from pebble.services.ros1_bridge import messages
from pebble.services.ros1_bridge.config import LocalPlan, Metric, Ros1, Sampled
from pebble.services.ros1_bridge.messages import Form, Goal, Header, Health, Pose
from pebble.services.ros1_bridge.node import Node
from pebble.transports.counters import Counters

log = logging.getLogger(__name__)

LEVEL_S = 1.0  # between two levels of the battery, at least
NAVIGATES_S = 5.0  # a planner that is silent for so long does nothing
_ACTIVE = (0, 1, 6, 7)  # codes of goals that are pursued or about to be
_CODES = (
    *("PENDING", "ACTIVE", "PREEMPTED", "SUCCEEDED", "ABORTED", "REJECTED", "PREEMPTING", "RECALLING", "RECALLED"),
    "LOST",
)
_LEVELS = ("OK", "WARN", "ERROR", "STALE")
_UNITS = {"(V)": "v", "(%)": "%"}

Publish = Callable[[Channel, dict[str, Any]], object]


class Telemetry:
    """A reader of ROS topics that calls ``publish(channel, payload)`` on the node's thread of sockets.

    ``on_odometry()`` is called with each odometry, whether it is published or not.
    """

    def __init__(
        self, node: Node, section: Ros1, publish: Publish, counters: Counters, on_odometry: Callable[[], object]
    ) -> None:
        self._metrics, self._names, self._publish = section.telemetry, section.ros, publish
        self._counters, self._on_odometry = counters, on_odometry
        self._log = RateLimitedLog(log)
        self._due: dict[Channel, float] = {}  # when a channel may be published again
        self._goal: dict[str, Any] | None = None  # the newest one, which the status repeats
        self._navigates_at = float("-inf")  # when a planner was last seen to pursue a goal
        metrics, names = self._metrics, self._names
        battery = metrics.charging_level.enabled or metrics.charging_status.enabled
        status = metrics.navigation_status.enabled
        topics: tuple[tuple[bool, str, Form, Callable[[bytes], None]], ...] = (
            (True, names.odometry_topic, messages.ODOMETRY, self._odometry),
            (battery or metrics.diagnostics.enabled, names.diagnostics_topic, messages.DIAGNOSTICS, self._diagnostics),
            # a bridge that drives needs it as well, see navigates
            (status or section.drives, names.navigation_status_topic, messages.GOAL_STATUS, self._status),
            (status or metrics.navigation_goal.enabled, names.navigation_goal_topic, messages.POSE, self._take_goal),
        )
        for wanted, topic, form, read in topics:
            if wanted:
                node.subscribe(topic, form, self._reader(topic, read))
        for channel, topic, metric in (
            (c.NAVIGATION_LOCAL_PLAN, names.navigation_local_plan_topic, metrics.navigation_local_plan),
            (c.NAVIGATION_GLOBAL_PLAN, names.navigation_global_plan_topic, metrics.navigation_global_plan),
        ):
            if metric.enabled:
                node.subscribe(topic, messages.PATH, self._reader(topic, partial(self._plan, channel, topic, metric)))

    @property
    def navigates(self) -> bool:
        """True while a planner pursues a goal."""
        return time.monotonic() - self._navigates_at < NAVIGATES_S

    def _reader(self, topic: str, read: Callable[[bytes], None]) -> Callable[[bytes], None]:
        """Return a function that reads a message, and counts it if it is damaged."""

        def receive(body: bytes) -> None:
            try:
                read(body)
            except (struct.error, ValueError, IndexError) as error:
                self._counters.add("ros_unread")
                self._log.warning(topic, "%s: a message that is not understood: %s", topic, error)

        return receive

    def _is_due(self, channel: Channel, metric: Metric, interval_s: float) -> bool:
        """True if the metric is enabled, and its interval is over."""
        now = time.monotonic()
        if not metric.enabled or now < self._due.get(channel, 0.0):
            return False
        self._due[channel] = now + interval_s
        return True

    def _sampled(self, channel: Channel, metric: Sampled) -> bool:
        return self._is_due(channel, metric, metric.interval_seconds)

    # -- on the node's thread of sockets

    def _odometry(self, body: bytes) -> None:
        self._on_odometry()
        wheels = self._sampled(c.WHEEL_ODOMETRY, self._metrics.wheel_odometry)
        pose = self._sampled(c.LOCALIZATION_POSE, self._metrics.localization_pose)
        if not (wheels or pose):
            return
        read = messages.odometry(body)
        x, y, z = read.position
        yaw = messages.yaw(read.quaternion)
        _refuse_infinite(x, y, z, yaw, read.linear, read.angular)
        if wheels:
            value = {
                "x_mm": round(1000 * x, 3), "y_mm": round(1000 * y, 3), "heading_rad": round(yaw, 6),
                "heading_deg": round(math.degrees(yaw), 3), "linear_speed_mps": round(read.linear, 6),
                "angular_speed_radps": round(read.angular, 6),
            }  # fmt: skip
            stamp = _stamp(read.header)
            # Unlike in what `_tell` publishes, the source is a fixed name, not a topic.
            payload = {"value": value, "unit": "mm", "source": "ros-odometry", "timestamp": stamp}
            self._publish(c.WHEEL_ODOMETRY, payload)
        if pose:
            value = {
                **_place(read.position, yaw), "linear_velocity_mps": round(read.linear, 6),
                "angular_velocity_radps": round(read.angular, 6),
            }  # fmt: skip
            frames = {"frame_id": read.header.frame, "child_frame_id": read.child_frame}
            self._tell(c.LOCALIZATION_POSE, value, self._names.odometry_topic, read.header, **frames)

    def _take_goal(self, body: bytes) -> None:
        read: Pose = messages.pose(body)
        yaw = messages.yaw(read.quaternion)
        _refuse_infinite(*read.position, *read.quaternion)
        turn = {name: round(part, 6) for name, part in zip("xyzw", read.quaternion, strict=True)}
        self._goal = {"frame_id": read.header.frame, **_place(read.position, yaw), "orientation": turn}
        if self._metrics.navigation_goal.enabled:
            self._tell(c.NAVIGATION_GOAL, self._goal, self._names.navigation_goal_topic, read.header)

    def _status(self, body: bytes) -> None:
        """Note whether a planner pursues a goal, and publish the state of that goal, or of the newest, if it is due."""
        header, goals = messages.goals(body)
        newest = goals[-1] if goals else Goal("", -1, "")
        goal = next((goal for goal in goals if goal.code in _ACTIVE), newest)
        active = goal.code in _ACTIVE
        self._navigates_at = time.monotonic() if active else float("-inf")
        if not self._sampled(c.NAVIGATION_STATUS, self._metrics.navigation_status):
            return
        value = {
            "active": active, "goal_count": len(goals), "code": goal.code, "label": _label(_CODES, goal.code),
            "goal_id": goal.id, "text": goal.text, "goal": self._goal,
        }  # fmt: skip
        self._tell(c.NAVIGATION_STATUS, value, self._names.navigation_status_topic, header)

    def _plan(self, channel: Channel, topic: str, metric: LocalPlan, body: bytes) -> None:
        """Publish a planned path, by at most ``max_points`` of its points, evenly spread."""
        if not self._sampled(channel, metric):
            return
        header, points = messages.route(body)
        most = min(metric.max_points, len(points))
        step = (len(points) - 1) / (most - 1) if most > 1 else 0.0
        sample = [points[round(number * step)] for number in range(most)]  # with the first and the last
        for point in sample:
            _refuse_infinite(*point)
        shown = [{"x_m": round(x, 6), "y_m": round(y, 6), "z_m": round(z, 6)} for x, y, z in sample]
        value = {
            "frame_id": header.frame, "point_count": len(points), "sampled_point_count": most, "points": shown,
        }  # fmt: skip
        self._tell(channel, value, topic, header)

    def _diagnostics(self, body: bytes) -> None:
        """Publish the diagnostics as a whole, and the battery that is among them."""
        header, parts = messages.diagnostics(body)
        metrics = self._metrics
        if self._sampled(c.DIAGNOSTICS, metrics.diagnostics):
            worst = max((part.level for part in parts), default=0)
            value = {
                "level": worst, "label": _label(_LEVELS, worst),
                "items": _items(parts, metrics.diagnostics.max_items),
            }  # fmt: skip
            self._tell(c.DIAGNOSTICS, value, self._names.diagnostics_topic, header)
        for part in parts:
            self._battery(part, _stamp(header))

    def _battery(self, part: Health, stamp: float) -> None:
        """Publish the level and the status of charging that this part of the diagnostics has, each if it is due."""
        level, status = self._metrics.charging_level, self._metrics.charging_status
        if part.name == level.status_name and level.key in part.values:
            number = float(part.values[level.key])
            _refuse_infinite(number)
            if self._is_due(c.CHARGING_LEVEL, level, LEVEL_S):
                payload: dict[str, Any] = {"value": number, "timestamp": stamp}
                units = [unit for mark, unit in _UNITS.items() if mark in level.key]
                if units:
                    payload["unit"] = units[0]
                self._publish(c.CHARGING_LEVEL, payload)
        if part.name == status.status_name and status.key in part.values:
            word = part.values[status.key].strip().lower()
            charges = word in status.truthy_values
            is_understood = charges or word in status.falsey_values
            if is_understood and self._is_due(c.CHARGING_STATUS, status, LEVEL_S):
                self._publish(c.CHARGING_STATUS, {"value": charges, "timestamp": stamp})

    def _tell(self, channel: Channel, value: dict[str, Any], source: str, header: Header, **more: str) -> None:
        """Publish ``value`` with the topic ``source`` and the time in the header."""
        self._publish(channel, {"value": value, **more, "source": source, "timestamp": _stamp(header)})


def _stamp(header: Header) -> float:
    """Return the time of the measurement, in seconds; the present time if the sender gives none."""
    return header.stamp or time.time()


def _place(position: messages.Numbers, yaw: float) -> dict[str, float]:
    x, y, z = position
    return {
        "x_m": round(x, 6), "y_m": round(y, 6), "z_m": round(z, 6), "yaw_rad": round(yaw, 6),
        "yaw_deg": round(math.degrees(yaw), 3),
    }  # fmt: skip


def _items(parts: list[Health], most: int) -> list[dict[str, Any]]:
    """Return at most ``most`` diagnostics, the unhealthy ones first. (The original cuts off those behind ``most``.)"""
    unhealthy_first = sorted(parts, key=lambda part: part.level == 0)
    return [
        {"name": part.name, "level": part.level, "label": _label(_LEVELS, part.level), "message": part.message}
        for part in unhealthy_first[:most]
    ]


def _label(labels: tuple[str, ...], code: int) -> str:
    return labels[code] if 0 <= code < len(labels) else "UNKNOWN"


def _refuse_infinite(*numbers: float) -> None:
    """Raise ValueError for a number that JSON cannot hold: NaN or an infinity."""
    if not all(map(math.isfinite, numbers)):
        raise ValueError("a number is not finite")
