"""The newest value of every metric of every component, and which of them each page still needs.

A component is a robot, a board or a program with topics of its own; a metric is what follows the direction in a topic.
There is no queue: a slow page gets newest values less often. A page that connects again gets all of them.
"""

import logging
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any, NamedTuple

import msgspec

from pebble import contract as c
from pebble.contract import OUTGOING, channel_of, codec
from pebble.contract.identity import parse_topic
from pebble.errors import PayloadError
from pebble.extensions.operator.client.robot_topics import FLEET, topic_of
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.extensions.page import messages as m
from pebble.extensions.page.log_lines import LogLines
from pebble.extensions.page.shown import shown, with_name
from pebble.transports import Message

log = logging.getLogger(__name__)

MAX_COMPONENTS, MAX_METRICS, MAX_VALUE_BYTES = 2000, 200, 64 * 1024  # components; metrics of one; bytes of a value
_MAX_CLIPS_BYTES = 400 * 1024  # of the list of clips, which has up to 256 KiB of names
LARGE_BYTES = 16 * 1024  # a value beyond holds up a slow connection: one is sent, then the page has to answer
MAX_STATE_BYTES = 128 * 1024  # of values in one message: pings, by which pages drive, do not wait for thousands
MAX_BYTES = 64 * 1024 * 1024  # of all values together, but for those of components that are open, driven or stopped
_REFRESH_S = 1.0  # a component's values that change with every heartbeat are sent this often at most,
_REFRESHES_PER_S = 100  # and those of so many components a second, besides the open ones


class _Value(NamedTuple):
    raw: msgspec.Raw
    at: float  # monotonic


class Component:
    """A component, from the messages that it publishes."""

    def __init__(self, ref: str) -> None:
        self.ref = ref
        self.robot = RobotView(ref)
        self.values: dict[str, _Value] = {}
        self.sent_online: bool | None = None
        self.refreshed_at = float("-inf")

    def lists(self, metric: str) -> bool:
        """True if ``metric`` is the state of a motor owner, and the component's capabilities list that owner."""
        states, owners = (c.ESTOP_STATE, c.CONTROL_STATE), self.robot.estop.owners
        return metric in [state.metric.format(owner=owner) for state in states for owner in owners]


def liveness_of(robot: RobotView, now: float) -> m.Liveness:
    """Return whether a component is online, in the form for pages."""
    liveness = robot.liveness
    return m.Liveness(
        online=robot.online(now),
        silent_s=liveness.age_s(now),
        latency_ms=_ms(liveness.latency_s),
        average_latency_ms=_ms(liveness.average_latency_s),
        interval_ms=_ms(liveness.interval_s),
        whole_seconds=liveness.whole_seconds,
    )


def _ms(seconds: float | None) -> float | None:
    return None if seconds is None else 1000 * seconds


class Interest:
    """A page's subscription: the values that it still needs, and the component that it has open."""

    def __init__(self, changed: Callable[[], None]) -> None:
        self.watched = ""  # the component that it has open; "": none
        self.dirty: set[tuple[str, str]] = set()  # component and metric of each value that it still needs
        self.more = False  # what is dirty did not fit into the last message
        self.gone: set[str] = set()  # components that were removed since the last message
        self.notify = changed


class Robots:
    """The table of all components. Used on the event loop only."""

    def __init__(self) -> None:
        self.components: dict[str, Component] = {}
        #: True for a robot that gets a place even in a full table: it is open, driven or stopped.
        self.is_wanted: Callable[[str], bool] = lambda _ref: False
        #: True for a robot that never loses its place to another.
        self.is_kept: Callable[[str], bool] = lambda _ref: False
        self.names: Mapping[str, str] = {}  # of components that may have none of their own
        self.omitted = 0  # messages of components, metrics and values beyond the limits
        self.interests: set[Interest] = set()  # of the connected pages
        #: Called with a component whose retained messages are not known here (any more).
        self.on_forget: Callable[[str], object] = lambda _: None
        self.logs: dict[str, LogLines] = {}  # of watched components
        self.sources: dict[str, str] = {}  # the components whose pictures are shown on the pages of others
        self._server: dict[tuple[str, str], _Value] = {}  # the server's own metrics, by component and metric
        self._bytes = 0  # of all components' values

    # -- reading

    def view(self, ref: str) -> RobotView | None:
        component = self.components.get(ref)
        return None if component is None else component.robot

    def capabilities(self, ref: str) -> dict[str, Any]:
        """Return the component's capabilities; empty until they are known."""
        component = self.components.get(ref)
        return {} if component is None else component.robot.capabilities

    def topic(self, ref: str, channel: c.Channel) -> str:
        """Return the topic that the component's capabilities name for ``channel``, else the channel's own."""
        return topic_of(ref, self.capabilities(ref), channel)

    def value(self, ref: str, metric: str) -> msgspec.Raw | None:
        """Return the newest value, also of a metric of the server; None if there is none."""
        value = self._find(ref, metric)
        return None if value is None else value.raw

    def take(
        self, interest: Interest, now: float, *, large: bool
    ) -> tuple[tuple[tuple[str, str, Any, float], ...], bool]:
        """Return the values that this page still needs, and whether a large one is among them.

        Each: component, metric, value (None: removed), age in milliseconds. They count as sent from now on. The
        component that the page has open comes first. At most one large value is taken, and only with ``large``. The
        others, and what does not fit into this message, wait for the next.
        """
        dirty, interest.dirty = interest.dirty, set()
        taken: list[tuple[str, str, Any, float]] = []
        has_large, room = False, MAX_STATE_BYTES
        for ref, metric in sorted(dirty, key=lambda key: key[0] != interest.watched):  # first what is watched
            stored = self._find(ref, metric)
            size = 0 if stored is None else len(bytes(stored.raw))
            is_large = size > LARGE_BYTES
            if room <= 0 or (is_large and (has_large or not large)):
                interest.dirty.add((ref, metric))  # for the next message
                continue
            has_large = has_large or is_large
            room -= size
            if stored is None:
                taken.append((ref, metric, None, 0.0))
            else:
                taken.append((ref, metric, stored.raw, 1000 * (now - stored.at)))
        interest.more = room <= 0
        return tuple(taken), has_large

    def _find(self, ref: str, metric: str) -> _Value | None:
        if metric.startswith("web/"):
            return self._server.get((ref, metric))
        component = self.components.get(ref)
        return None if component is None else component.values.get(metric)

    # -- pages

    def join(self, interest: Interest) -> None:
        """Send all values to this page."""
        self.interests.add(interest)
        interest.dirty |= set(self._fleet_values()) | set(self._server)

    def watch(self, interest: Interest, ref: str) -> None:
        """Send this page all metrics of ``ref``."""
        interest.watched = ref
        component = self.components.get(ref)
        if component is not None:
            interest.dirty |= {(ref, metric) for metric in component.values}

    def leave(self, interest: Interest) -> None:
        self.interests.discard(interest)

    def _fleet_values(self) -> Iterator[tuple[str, str]]:
        """Yield component and metric of each value that all pages show."""
        for ref, component in self.components.items():
            for metric in component.values:
                if _channel(metric) in FLEET:
                    yield ref, metric

    # -- changes

    def set_server_metric(self, ref: str, metric: str, value: Any) -> None:
        """Set a metric of the server itself for all pages; unchanged values are not sent again."""
        raw = msgspec.Raw(msgspec.json.encode(value))
        old = self._server.get((ref, metric))
        if old is None or bytes(old.raw) != bytes(raw):
            self._server[ref, metric] = _Value(raw, time.monotonic())
            self._mark(ref, metric, everybody=True)

    def remove_server_metric(self, ref: str, metric: str) -> None:
        """Remove a metric of the server itself; pages keep its value until they receive another."""
        self._server.pop((ref, metric), None)

    def receive(self, message: Message, now: float) -> None:
        """Handle a message of any component."""
        address = parse_topic(message.topic)
        if address is None or address.direction != OUTGOING or address.identity.is_server:
            return
        self.receive_as(address.identity.base, address.metric, message, now)

    def receive_as(self, ref: str, metric: str, message: Message, now: float, channel: c.Channel | None = None) -> None:
        """Handle a message as if it had come on ``metric`` of component ``ref``: its own topic may name neither.

        ``channel``: how to decode it, if the contract does not have it.
        """
        component = self.components.get(ref) or self._add(ref)
        channel = channel or _channel(metric)
        if component is None or channel is None:
            return
        if channel is c.LOGS:
            self._log(component, message)
            return
        if not message.payload:  # a removal, of which the robot's view has to learn as well: see _interpret
            self._remove_value(component, metric)
        trimmed = codec.trim(message.payload)  # without what may not be in a JSON message to pages
        if trimmed != message.payload:
            message = msgspec.structs.replace(message, payload=trimmed)
        if message.payload and not self._store(component, metric, channel, message, now):
            return
        self._interpret(component, channel, message, now)

    def forget(self, ref: str) -> None:
        """Remove a component, if it is there. It comes back with its next message."""
        component = self.components.pop(ref, None)
        if component is not None:
            self._bytes -= sum(len(bytes(value.raw)) for value in component.values.values())
        self.on_forget(ref)
        for key in [key for key in self._server if key[0] == ref]:
            del self._server[key]
        for interest in self.interests:
            interest.gone.add(ref)
            interest.notify()

    def refresh(self, now: float) -> None:
        """Send values that change with time. Call this every 0.25 s.

        Whether a component is online is sent at once. Ages are sent each second for open components. The others
        take turns, at most _REFRESHES_PER_S of them a second, so that a thousand robots cause no flood. One call sends
        about a third of this number at most.
        """
        due: list[Component] = []
        opened = {interest.watched for interest in self.interests}
        turn_s = max(_REFRESH_S, len(self.components) / _REFRESHES_PER_S)
        for component in self.components.values():
            waited_s = now - component.refreshed_at  # infinite: nothing was sent yet
            changed = component.robot.online(now) is not component.sent_online or waited_s == float("inf")
            has_ages = component.robot.live or component.sent_online is not None  # else nothing that grows older
            is_open = component.ref in opened
            if changed or (has_ages and is_open and waited_s >= _REFRESH_S):
                self._refresh(component, now)
            elif has_ages and waited_s >= turn_s:
                due.append(component)
        due.sort(key=lambda component: component.refreshed_at)
        at_once = 1 + min(len(self.components), _REFRESHES_PER_S) // 3  # not a quarter, so that a late call catches up
        for component in due[:at_once]:
            self._refresh(component, now)

    def _refresh(self, component: Component, now: float) -> None:
        component.sent_online, component.refreshed_at = component.robot.online(now), now
        self.set_server_metric(component.ref, "web/liveness", liveness_of(component.robot, now))
        if c.ONLINE.metric in component.values:
            self._mark(component.ref, c.ONLINE.metric)

    def _add(self, ref: str) -> Component | None:
        """Add a component; None if the table is full.

        A wanted one replaces the newest that need not be kept; where all are kept, it is one more.
        """
        if len(self.components) >= MAX_COMPONENTS:
            if not self.omitted:
                log.warning("more than %d components at this broker: give it accounts", MAX_COMPONENTS)
            self.omitted += 1
            if not self.is_wanted(ref):
                return None
            newest = next((other for other in reversed(self.components) if not self.is_kept(other)), None)
            if newest is not None:
                self.forget(newest)
            self.on_forget(ref)  # its earlier messages were omitted: the retained ones are asked for again
        component = self.components[ref] = Component(ref)
        return component

    def _has_room(self, component: Component, metric: str, channel: c.Channel, more_bytes: int) -> bool:
        """True if a value may be stored. States of motor owners always may, as stop and control depend on them."""
        if component.lists(metric):  # it is the state of a motor owner
            return True
        is_new = metric not in component.values
        if is_new and len(component.values) >= MAX_METRICS and channel.is_pattern:  # the other channels are few
            return False
        return self._bytes + more_bytes <= MAX_BYTES or self.is_kept(component.ref)

    def _store(self, component: Component, metric: str, channel: c.Channel, message: Message, now: float) -> bool:
        """Check and store the value; return False if it is refused."""
        old = component.values.get(metric)
        most_bytes = _MAX_CLIPS_BYTES if channel is c.SOUNDBOARD_FILES else MAX_VALUE_BYTES
        if len(message.payload) > most_bytes:
            self.omitted += 1
            return False
        try:
            raw = shown(channel, message.payload, codec.plain(channel, message.payload))
        except PayloadError:
            return False
        if channel is c.CAPABILITIES and component.ref in self.names:
            raw = with_name(raw, self.names[component.ref])
        more_bytes = len(raw) - (0 if old is None else len(bytes(old.raw)))
        if not self._has_room(component, metric, channel, more_bytes):
            self.omitted += 1
            return False
        self._bytes += more_bytes
        component.values[metric] = _Value(msgspec.Raw(raw), now)
        if channel is not c.ONLINE:  # heartbeats are sent with the liveness, less often: see _refresh
            self._mark(component.ref, metric)
        return True

    def _remove_value(self, component: Component, metric: str) -> None:
        """Remove a retained value after an empty message."""
        old = component.values.pop(metric, None)
        if old is not None:
            self._bytes -= len(bytes(old.raw))
            self._mark(component.ref, metric)

    def _interpret(self, component: Component, channel: c.Channel, message: Message, now: float) -> None:
        """Update the view of the robot from a message that arrived at ``now``."""
        robot, capabilities_before = component.robot, component.robot.capabilities
        wall = time.time() - (time.monotonic() - now)  # the epoch time at ``now``, which is monotonic
        robot.receive(channel, message, now, wall)
        if robot.capabilities is not capabilities_before and "announced" in robot.capabilities:
            self.show_announced(component, now)
        if robot.liveness.reported_offline and component.sent_online is not False:
            self._refresh(component, now)  # at once: it may be back before the next `refresh`

    def show_announced(self, component: Component, now: float) -> None:
        """Send pages the capabilities that a component announces, or is assumed to have, until it publishes its own."""
        if not component.robot.capabilities:
            self._remove_value(component, c.CAPABILITIES.metric)
            return
        payload = msgspec.json.encode({"t": int(1000 * time.time()), "value": component.robot.capabilities})
        message = Message(c.CAPABILITIES.topic(component.ref), payload)
        self._store(component, c.CAPABILITIES.metric, c.CAPABILITIES, message, now)

    def _log(self, component: Component, message: Message) -> None:
        """Add a live log line of a watched component, and tell the pages that watch it."""
        lines = self.logs.get(component.ref)
        if lines is None or message.retain or not message.payload:
            return
        lines.add(message.payload)
        for interest in self.interests:
            if interest.watched == component.ref:
                interest.notify()

    def mark_drivers(self, refs: Collection[str]) -> None:
        """Update, for all pages, who drives these robots."""
        if refs:
            for interest in self.interests:
                interest.dirty |= {(ref, "web/driver") for ref in refs}
                interest.notify()

    def _mark(self, ref: str, metric: str, *, everybody: bool = False) -> None:
        """Note that pages need a value: all if ``everybody`` or it is of FLEET; else those that show ``ref``."""
        channel = _channel(metric)
        everybody = everybody or channel in FLEET
        for interest in self.interests:
            # drawings over the picture of ``ref``, which this page shows for the component that it has open
            is_drawn = channel is c.VIDEO_OVERLAYS and self.sources.get(interest.watched) == ref
            if everybody or is_drawn or interest.watched == ref:
                interest.dirty.add((ref, metric))
                interest.notify()


def _channel(metric: str) -> c.Channel | None:
    return channel_of(f"{OUTGOING}/{metric}")
