"""What is received of the components that pages have open, besides what is received of all."""

from __future__ import annotations

import asyncio
from collections import Counter, deque
from collections.abc import Callable, Coroutine
from typing import Any

from pebble.contract import (
    AUTONOMY_FILES,
    AUTONOMY_STATUS,
    CHARGING_LEVEL,
    CHARGING_STATUS,
    IMU,
    SOUNDBOARD_FILES,
    SOUNDBOARD_STATUS,
    TOUCH_SENSORS,
    WHEEL_ODOMETRY,
    Channel,
    Kind,
)
from pebble.contract.identity import Direction
from pebble.contract.payloads import AnyObject
from pebble.transports import Message, Subscription
from pebble.web.broker import Broker
from pebble.web.robots import LOG_LINES, WATCHED, Robots, own_topic, section_of

_KEEP_S = 5.0  # so long they are still received after the last page has closed the component
_STEP_S = 1.0  # between two changes of what is received of one component: capabilities may change without end

#: Channels whose topic capabilities may name, by its section and key there.
_NAMED: dict[tuple[str, str], Channel] = {
    ("telemetry", "touch_topic"): TOUCH_SENSORS,
    ("telemetry", "charging_topic"): CHARGING_STATUS,
    ("telemetry", "charging_level_topic"): CHARGING_LEVEL,
    ("telemetry", "wheel_odometry_topic"): WHEEL_ODOMETRY,
    ("telemetry", "imu_topic"): IMU,
    ("soundboard", "files_topic"): SOUNDBOARD_FILES,
    ("soundboard", "status_topic"): SOUNDBOARD_STATUS,
    ("autonomy", "files_topic"): AUTONOMY_FILES,
    ("autonomy", "status_topic"): AUTONOMY_STATUS,
}


class OpenComponents:
    """Subscribes while at least one page has a component open. Only the event loop calls it."""

    def __init__(self, broker: Broker, robots: Robots, spawn: Callable[[Coroutine[Any, Any, None]], None]) -> None:
        """``spawn`` runs a coroutine in the background."""
        self._broker, self._robots, self._spawn = broker, robots, spawn
        self._pages: Counter[str] = Counter()
        self._subscriptions: dict[str, dict[str, Subscription]] = {}  # by component and filter
        self._following: set[str] = set()  # components whose task runs
        self._wanted: dict[str, dict[str, Channel | None]] = {}  # filters, and what else than their own name they carry

    def open(self, ref: str) -> None:
        """A page has opened this component."""
        self._pages[ref] += 1
        self._robots.logs.setdefault(ref, deque(maxlen=LOG_LINES))
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
                    self._subscriptions.pop(ref)
                    return
                await asyncio.sleep(_STEP_S)
                if list(self._filters(ref) if ref in self._pages else {}) == list(wanted):
                    return
        finally:
            self._following.discard(ref)

    def _receiver(self, ref: str, filter_: str) -> Callable[[Message, float], None]:
        def take(message: Message, now: float) -> None:
            channel = self._wanted.get(ref, {}).get(filter_)
            before = self._robots.aliases(ref)
            if channel is None:
                self._robots.receive(message, now)
            else:
                self._robots.receive_as(ref, channel.metric, message, now, channel)
            if self._robots.aliases(ref) != before:
                self.update(ref)

        return take

    def _filters(self, ref: str) -> dict[str, Channel | None]:
        """Every channel's own topic; those that capabilities and manifests name, if they are the component's own."""
        filters: dict[str, Channel | None] = {channel.filter(ref): None for channel in WATCHED}
        capabilities = self._robots.capabilities(ref)
        for (section, key), channel in _NAMED.items():
            topic = section_of(capabilities, section).get(key)
            if own_topic(ref, topic, Direction.OUTGOING) and str(topic) not in (*filters, channel.topic(ref)):
                filters[str(topic)] = channel
        for metric in self._robots.aliases(ref):
            filters.setdefault(
                f"{ref}/{Direction.OUTGOING}/{metric}", Channel(metric=metric, kind=Kind.STREAM, payload=AnyObject)
            )
        return filters
