"""Discovers robots by their outgoing topics: identity, liveness, capabilities, emergency stop, battery and script."""

from __future__ import annotations

from collections import deque
from typing import Any

from pebble.client.driveable import Driveable, driveable_of
from pebble.client.estop_states import RobotEstop
from pebble.contract import (
    AUTONOMY_STATUS,
    CAPABILITIES,
    CHARGING_LEVEL,
    CHARGING_STATUS,
    IMU,
    ONLINE,
    OUTGOING,
    STATUS,
    Channel,
    channel_of,
    codec,
)
from pebble.contract.identity import is_of_another, parse_topic
from pebble.contract.payloads import AutonomyStatus, EstopState, Orientation
from pebble.errors import PayloadError
from pebble.media.rate_meter import RateMeter
from pebble.transports import Message

ALL_OUTGOING = f"+/+/+/{OUTGOING}/#"
_HISTORY = 10


class Liveness:
    """Is a component online? As on the paper's operator page, the timeout follows the heartbeat's own interval."""

    def __init__(self) -> None:
        self.received_at: float | None = None  # monotonic
        self.reported_offline = False
        self._intervals: deque[float] = deque(maxlen=_HISTORY)
        self._latencies: deque[float] = deque(maxlen=_HISTORY)

    def heartbeat(self, now: float, latency_s: float, *, online: bool = True) -> None:
        if self.received_at is not None and 0.05 <= now - self.received_at <= 10.0:
            self._intervals.append(now - self.received_at)
        if -1.0 <= latency_s <= 10.0:
            self._latencies.append(max(0.0, latency_s))
        self.received_at, self.reported_offline = now, not online

    @property
    def latency_s(self) -> float | None:
        """Of the newest heartbeat; correct only if both clocks are synchronised, as on one machine."""
        return self._latencies[-1] if self._latencies else None

    @property
    def average_latency_s(self) -> float | None:
        """Of the last ten heartbeats."""
        return _mean(self._latencies)

    @property
    def interval_s(self) -> float | None:
        """Between heartbeats: the mean of the last ten."""
        return _mean(self._intervals)

    def age_s(self, now: float) -> float | None:
        return None if self.received_at is None else now - self.received_at

    def online(self, now: float) -> bool | None:
        """None while there are too few heartbeats to decide."""
        if self.reported_offline:
            return False
        interval, latency = self.interval_s, self.average_latency_s
        if self.received_at is None or len(self._intervals) < 2 or interval is None or latency is None:
            return None
        return now - self.received_at <= max(2 * interval, 4 * latency)


def _mean(values: deque[float]) -> float | None:
    return sum(values) / len(values) if values else None


class DiscoveredRobot:
    """One robot, by the messages it publishes."""

    def __init__(self, base: str, name: str) -> None:
        self.base, self.name = base, name
        self.liveness = Liveness()
        self.messages = RateMeter()
        self.capabilities: dict[str, Any] = {}
        self.estop = RobotEstop(base)
        self.driveable: Driveable | None = None  # as its status says
        self.volts: float | None = None
        self.charging: bool | None = None
        self.attitude: Orientation | None = None  # of the newest sample of its inertial sensor
        self.autonomy: AutonomyStatus | None = None

    @property
    def transport(self) -> str:
        return str(self.capabilities.get("transport", {}).get("kind", "?"))

    @property
    def latched(self) -> bool:
        """Whether any of its motor owners is stopped by an emergency stop: it must not be driven."""
        return bool(self.estop.latched)

    @property
    def stopped_by(self) -> EstopState | None:
        """The state that holds the newest stop, if it is stopped."""
        return self.estop.stopped_by

    @property
    def drive_topic(self) -> str | None:
        """The topic of its drive commands; None until its capabilities have arrived."""
        return self._topic("drive", "topic")

    def lights_topic(self, *, flash: bool) -> str | None:
        return self._topic("lights", "flash_topic" if flash else "solid_topic")

    def offers(self, section: str) -> bool:
        """Whether that section of its capabilities, for example ``video``, can be requested."""
        return self.capabilities.get(section, {}).get("controls") is True

    def ready(self, now: float) -> bool:
        """Online, with a known drive topic."""
        return self.drive_topic is not None and self.liveness.online(now) is True

    def _topic(self, section: str, key: str) -> str | None:
        topic = self.capabilities.get(section, {}).get(key)
        return topic if isinstance(topic, str) and not is_of_another(topic, self.base) else None


class Discovery:
    """All robots that have published anything, by base topic. One thread calls ``receive``; others only read."""

    def __init__(self) -> None:
        self.robots: dict[str, DiscoveredRobot] = {}

    def all_robots(self) -> list[DiscoveredRobot]:
        return list(self.robots.values())  # a copy: robots may be added meanwhile

    def receive(self, message: Message, now: float, wall: float) -> None:
        """Update from one message that arrived at ``now`` (monotonic) and ``wall`` (epoch seconds)."""
        address = parse_topic(message.topic)
        if address is None or address.identity.is_server:
            return
        identity = address.identity
        robot = self.robots.get(identity.base)
        if robot is None:
            robot = self.robots[identity.base] = DiscoveredRobot(identity.base, identity.id)
        robot.messages.add(now, len(message.payload))
        robot.estop.receive(message)
        channel = channel_of(f"{address.direction}/{address.metric}")
        if channel in _KNOWN:
            self._update(robot, channel, message, now, wall)

    def _update(self, robot: DiscoveredRobot, channel: Channel, message: Message, now: float, wall: float) -> None:
        try:
            payload = codec.decode(channel, message.payload)
        except PayloadError:  # a malformed message: the last valid state stays
            return
        if channel is ONLINE:
            if not message.retain:  # a retained heartbeat is no sign of life
                robot.liveness.heartbeat(now, wall - payload.t / 1000, online=payload.online is not False)
        elif channel is CAPABILITIES:
            robot.capabilities = payload.value
        elif channel is CHARGING_LEVEL:
            robot.volts = payload.value
        elif channel is IMU:
            robot.attitude = payload.value.orientation_deg
        elif channel is AUTONOMY_STATUS:
            robot.autonomy = payload
        elif channel is STATUS:
            robot.driveable = driveable_of(message.payload)
        else:
            robot.charging = payload.value


_KNOWN = (ONLINE, CAPABILITIES, CHARGING_LEVEL, CHARGING_STATUS, IMU, AUTONOMY_STATUS, STATUS)
