"""What is received of the components that pages have open, besides what is received of all."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable, Coroutine
from typing import Any

from msgspec.structs import replace

from pebble.contract import (
    CHARGING_LEVEL,
    CHARGING_STATUS,
    IMU,
    LOGS,
    MQTT_AUDIO,
    MQTT_VIDEO,
    REMOTE_MIRROR,
    TOUCH_SENSORS,
    WHEEL_ODOMETRY,
    Channel,
    Kind,
    codec,
)
from pebble.contract.identity import Direction
from pebble.errors import PayloadError
from pebble.transports import Message, Subscription
from pebble.web.broker import Broker
from pebble.web.log_lines import LogLines
from pebble.web.messages import FlagsView
from pebble.web.robots import WATCHED, Robots, own_topic

_KEEP_S = 5.0  # so long they are still received after the last page has closed the component
_FLAGS_METRIC = "web/flags"
_STEP_S = 1.0  # between two changes of what is received of one component: capabilities may change without end

#: Channels whose topic capabilities may name, below ``telemetry``.
_TELEMETRY: dict[str, Channel] = {
    "touch_topic": TOUCH_SENSORS,
    "charging_topic": CHARGING_STATUS,
    "charging_level_topic": CHARGING_LEVEL,
    "wheel_odometry_topic": WHEEL_ODOMETRY,
    "imu_topic": IMU,
}
#: By section of the capabilities that may name its topic, each flag and its field of FlagsView.
_FLAGS: dict[str, tuple[Channel, str]] = {
    "": (REMOTE_MIRROR, "remote_mirror"),
    "audio": (MQTT_AUDIO, "mqtt_audio"),
    "video": (MQTT_VIDEO, "mqtt_video"),
}
_FLAG_FIELDS = dict(_FLAGS.values())


class OpenComponents:
    """Subscribes while at least one page has a component open. Only the event loop calls it."""

    def __init__(self, broker: Broker, robots: Robots, spawn: Callable[[Coroutine[Any, Any, None]], None]) -> None:
        """``spawn`` runs a coroutine in the background."""
        self._broker, self._robots, self._spawn = broker, robots, spawn
        self._pages: Counter[str] = Counter()
        self._subscriptions: dict[str, dict[str, Subscription]] = {}  # by component and filter
        self._following: set[str] = set()  # components whose task runs
        self._wanted: dict[str, dict[str, Channel | None]] = {}  # filters, and what else than their own name they carry
        self._flags: dict[str, FlagsView] = {}
        broker.on_state(self._forget_flags)

    def open(self, ref: str) -> None:
        """A page has opened this component."""
        self._pages[ref] += 1
        self._robots.logs.setdefault(ref, LogLines())
        self.update(ref)

    def close(self, ref: str) -> None:
        """A page has closed it."""
        self._pages[ref] -= 1
        if not self._pages[ref]:
            del self._pages[ref]
            self._broker.loop.call_later(_KEEP_S, self.update, ref)

    def update(self, ref: str) -> None:
        """Its capabilities, or the pages that have it open, may have changed."""
        wanted = self._filters(ref) if ref in self._pages else {}
        if ref not in self._following and set(wanted) != set(self._subscriptions.get(ref, ())):
            self._following.add(ref)
            self._spawn(self._follow(ref))

    async def _follow(self, ref: str) -> None:
        """Subscribe and unsubscribe until what is received is what is wanted."""
        try:
            done = self._subscriptions.setdefault(ref, {})
            while True:
                if not done:
                    self._show_flags(ref, FlagsView())  # those that were removed meanwhile do not arrive
                wanted = self._wanted[ref] = self._filters(ref) if ref in self._pages else {}
                for filter_ in [filter_ for filter_ in done if filter_ not in wanted]:
                    await self._broker.unsubscribe(done.pop(filter_))
                for filter_ in [filter_ for filter_ in wanted if filter_ not in done]:
                    done[filter_] = await self._subscribe(ref, filter_)
                if not wanted:
                    if ref in self._pages:  # opened again meanwhile
                        continue
                    self._robots.logs.pop(ref, None)
                    self._flags.pop(ref, None)
                    self._robots.remove_server_metric(ref, _FLAGS_METRIC)
                    self._subscriptions.pop(ref)
                    return
                await asyncio.sleep(_STEP_S)
                if set(self._filters(ref) if ref in self._pages else {}) == set(wanted):
                    return
        finally:
            self._following.discard(ref)

    async def _subscribe(self, ref: str, filter_: str) -> Subscription:
        receiver = self._receiver(ref, filter_)
        if filter_ != LOGS.topic(ref):
            return await self._broker.subscribe(filter_, receiver)

        def count() -> None:
            lines = self._robots.logs.get(ref)
            if lines is not None:
                lines.refused += 1

        return await self._broker.subscribe(filter_, receiver, on_refused=count)

    def _receiver(self, ref: str, filter_: str) -> Callable[[Message, float], None]:
        def take(message: Message, now: float) -> None:
            channel = self._wanted.get(ref, {}).get(filter_)
            if channel is None:
                self._robots.receive(message, now)
            elif channel.kind is Kind.FLAG:
                self._receive_flag(ref, channel, message)
            else:
                self._robots.receive_as(ref, channel.metric, message, now)

        return take

    def _receive_flag(self, ref: str, channel: Channel, message: Message) -> None:
        """Its newest value; an empty message removes what was retained."""
        try:
            value = codec.decode(channel, message.payload) if message.payload else None
        except PayloadError:
            return
        view = replace(self._flags.get(ref, FlagsView()), **{_FLAG_FIELDS[channel]: value})
        self._show_flags(ref, view)

    def _show_flags(self, ref: str, view: FlagsView) -> None:
        self._flags[ref] = view
        self._robots.set_server_metric(ref, _FLAGS_METRIC, view)

    def _forget_flags(self) -> None:
        """They arrive again with the next connection, except those that are removed meanwhile."""
        if not self._broker.connected:
            for ref in list(self._flags):
                self._show_flags(ref, FlagsView())

    def _filters(self, ref: str) -> dict[str, Channel | None]:
        """Every channel's own topic, those that the capabilities name, if they are the component's own, and flags."""
        filters: dict[str, Channel | None] = {channel.filter(ref): None for channel in WATCHED}
        listed = self._robots.capabilities(ref).get("telemetry")
        for key, channel in _TELEMETRY.items():
            topic = listed.get(key) if isinstance(listed, dict) else None
            if own_topic(ref, topic, Direction.OUTGOING) and str(topic) not in filters:
                filters[str(topic)] = channel
        for section, (flag, _) in _FLAGS.items():
            filters[self._robots.topic(ref, section, "flag_topic", flag)] = flag
        return filters
