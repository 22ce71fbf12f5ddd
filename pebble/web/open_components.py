"""What is received of the components that pages have open, besides what is received of all."""

from __future__ import annotations

import asyncio
from collections import Counter, deque
from collections.abc import Callable, Coroutine
from typing import Any

from pebble.contract import (
    CHARGING_LEVEL,
    CHARGING_STATUS,
    IMU,
    TOUCH_SENSORS,
    VIDEO_OVERLAYS,
    WHEEL_ODOMETRY,
    Channel,
)
from pebble.contract.identity import Direction
from pebble.transports import Message, Subscription
from pebble.web.broker import Broker
from pebble.web.robots import LOG_LINES, WATCHED, Robots, own_topic

_KEEP_S = 5.0  # so long they are still received after the last page has closed the component
_STEP_S = 1.0  # between two changes of what is received of one component: capabilities may change without end

#: The component and channel of what a topic carries, where its own name does not tell them.
_Carried = tuple[str, Channel] | None

#: Channels whose topic capabilities may name, below ``telemetry``.
_TELEMETRY: dict[str, Channel] = {
    "touch_topic": TOUCH_SENSORS,
    "charging_topic": CHARGING_STATUS,
    "charging_level_topic": CHARGING_LEVEL,
    "wheel_odometry_topic": WHEEL_ODOMETRY,
    "imu_topic": IMU,
}


class OpenComponents:
    """Subscribes while at least one page has a component open. Only the event loop calls it."""

    def __init__(self, broker: Broker, robots: Robots, spawn: Callable[[Coroutine[Any, Any, None]], None]) -> None:
        """``spawn`` runs a coroutine in the background."""
        self._broker, self._robots, self._spawn = broker, robots, spawn
        self._pages: Counter[str] = Counter()
        self._subscriptions: dict[str, dict[str, Subscription]] = {}  # by component and filter
        self._following: set[str] = set()  # components whose task runs
        self._wanted: dict[str, dict[str, _Carried]] = {}  # by component and filter

    def open(self, ref: str) -> None:
        """A page has opened this component."""
        self._pages[ref] += 1
        self._robots.logs.setdefault(ref, deque(maxlen=LOG_LINES))
        self._robots.recent.open(ref)
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
        if ref not in self._following and list(wanted) != list(self._subscriptions.get(ref, ())):
            self._following.add(ref)
            self._spawn(self._follow(ref))

    async def _follow(self, ref: str) -> None:
        """Subscribe and unsubscribe until what is received is what is wanted."""
        try:
            done = self._subscriptions.setdefault(ref, {})
            while True:
                wanted = self._wanted[ref] = self._filters(ref) if ref in self._pages else {}
                for filter_ in [filter_ for filter_ in done if filter_ not in wanted]:
                    await self._broker.unsubscribe(done.pop(filter_))
                for filter_ in [filter_ for filter_ in wanted if filter_ not in done]:
                    done[filter_] = await self._broker.subscribe(filter_, self._receiver(ref, filter_))
                if not wanted:
                    self._robots.logs.pop(ref, None)
                    self._robots.recent.close(ref)
                    self._subscriptions.pop(ref)
                    return
                await asyncio.sleep(_STEP_S)
                if list(self._filters(ref) if ref in self._pages else {}) == list(wanted):
                    return
        finally:
            self._following.discard(ref)

    def _receiver(self, ref: str, filter_: str) -> Callable[[Message, float], None]:
        def take(message: Message, now: float) -> None:
            carried = self._wanted.get(ref, {}).get(filter_)
            if carried is None:
                self._robots.receive(message, now)
            else:
                self._robots.receive_as(carried[0], carried[1].metric, message, now)

        return take

    def _filters(self, ref: str) -> dict[str, _Carried]:
        """Every channel's own topic, those that the capabilities name, and what is drawn over another's picture."""
        filters: dict[str, _Carried] = {channel.filter(ref): None for channel in WATCHED}
        for key, channel in _TELEMETRY.items():
            self._add(filters, ref, "telemetry", key, channel)
        source = self._robots.sources.get(ref, ref)
        filters.setdefault(VIDEO_OVERLAYS.filter(source), None)
        self._add(filters, source, "video", "overlays_topic", VIDEO_OVERLAYS)
        return filters

    def _add(self, filters: dict[str, _Carried], ref: str, section: str, key: str, channel: Channel) -> None:
        """The topic that the capabilities name, if it is the component's own."""
        listed = self._robots.capabilities(ref).get(section)
        topic = listed.get(key) if isinstance(listed, dict) else None
        if own_topic(ref, topic, Direction.OUTGOING):
            filters.setdefault(str(topic), (ref, channel))
