"""What an operator learns of robots by listening to a broker: who is there, how alive, and what they report."""

from __future__ import annotations

from collections import deque
from typing import Any

from pebble import codec
from pebble.contract import (
    CAPABILITIES,
    CHARGING_LEVEL,
    CHARGING_STATUS,
    IMU,
    ONLINE,
    OUTGOING,
    Channel,
    channel_of,
)
from pebble.errors import PayloadError
from pebble.identity import parse_topic
from pebble.payloads import Orientation
from pebble.transports import Message

EVERYBODY = f"+/+/+/{OUTGOING}/#"
_HISTORY = 10


class Liveness:
    """Is a component online? The rule of the paper's operator page: silence is judged by its own heartbeat's rhythm."""

    def __init__(self) -> None:
        self.heard_at: float | None = None  # monotonic
        self._said_offline = False
        self._intervals: deque[float] = deque(maxlen=_HISTORY)
        self._latencies: deque[float] = deque(maxlen=_HISTORY)

    def heartbeat(self, now: float, latency_s: float, *, online: bool = True) -> None:
        if self.heard_at is not None and 0.05 <= now - self.heard_at <= 10.0:
            self._intervals.append(now - self.heard_at)
        if -1.0 <= latency_s <= 10.0:
            self._latencies.append(max(0.0, latency_s))
        self.heard_at, self._said_offline = now, not online

    @property
    def latency_s(self) -> float | None:
        """Of the newest heartbeat; needs both clocks to agree, as they do on one machine."""
        return self._latencies[-1] if self._latencies else None

    def age_s(self, now: float) -> float | None:
        return None if self.heard_at is None else now - self.heard_at

    def online(self, now: float) -> bool | None:
        """None while there were too few heartbeats to tell."""
        if self._said_offline:
            return False
        if self.heard_at is None or len(self._intervals) < 2 or not self._latencies:
            return None
        window = max(2 * sum(self._intervals) / len(self._intervals), 4 * sum(self._latencies) / len(self._latencies))
        return now - self.heard_at <= window


class Sighting:
    """One robot as seen from the broker."""

    def __init__(self, base: str, name: str) -> None:
        self.base, self.name = base, name
        self.liveness = Liveness()
        self.messages = 0
        self.capabilities: dict[str, Any] = {}
        self.volts: float | None = None
        self.charging: bool | None = None
        self.attitude: Orientation | None = None  # of the newest sample of its inertial sensor

    @property
    def transport(self) -> str:
        return str(self.capabilities.get("transport", {}).get("kind", "?"))

    @property
    def drive_topic(self) -> str | None:
        """Where it wants to be driven; None until its capabilities say so."""
        return self._topic("drive", "topic")

    def lights_topic(self, *, flash: bool) -> str | None:
        return self._topic("lights", "flash_topic" if flash else "solid_topic")

    def offers(self, section: str) -> bool:
        """Whether that part of its capabilities can be asked for: ``video``."""
        return self.capabilities.get(section, {}).get("controls") is True

    def ready(self, now: float) -> bool:
        """Alive, and it said how to drive it."""
        return self.drive_topic is not None and self.liveness.online(now) is True

    def _topic(self, section: str, key: str) -> str | None:
        topic = self.capabilities.get(section, {}).get(key)
        return topic if isinstance(topic, str) else None


class Discovery:
    """Everybody who ever spoke, by base topic. ``hear`` is called from one thread; others only read."""

    def __init__(self) -> None:
        self.sightings: dict[str, Sighting] = {}

    def everybody(self) -> list[Sighting]:
        return list(self.sightings.values())  # a copy: more may appear meanwhile

    def hear(self, message: Message, now: float, wall: float) -> None:
        """Learn from one message that arrived at ``now`` (monotonic) and ``wall`` (epoch seconds)."""
        address = parse_topic(message.topic)
        if address is None:
            return
        identity = address.identity
        sighting = self.sightings.get(identity.base)
        if sighting is None:
            sighting = self.sightings[identity.base] = Sighting(identity.base, identity.id)
        sighting.messages += 1
        channel = channel_of(f"{address.direction}/{address.metric}")
        if channel in _LEARN:
            self._learn(sighting, channel, message, now, wall)

    def _learn(self, sighting: Sighting, channel: Channel, message: Message, now: float, wall: float) -> None:
        try:
            payload = codec.decode(channel, message.payload)
        except PayloadError:  # somebody else's mistake: an operator's page shows what it understands
            return
        if channel is ONLINE:
            if not message.retain:  # a kept heartbeat tells nothing about now
                sighting.liveness.heartbeat(now, wall - payload.t / 1000, online=payload.online is not False)
        elif channel is CAPABILITIES:
            sighting.capabilities = payload.value
        elif channel is CHARGING_LEVEL:
            sighting.volts = payload.value
        elif channel is IMU:
            sighting.attitude = payload.value.orientation_deg
        else:
            sighting.charging = payload.value


_LEARN = (ONLINE, CAPABILITIES, CHARGING_LEVEL, CHARGING_STATUS, IMU)
