"""The robots of a broker for Foxglove: channels, declared when topics appear, and telemetry."""

import asyncio
import logging
import time
from typing import Final

import msgspec

from pebble.contract import AUTONOMY_STATUS, CAPABILITIES, STATUS, Channel
from pebble.contract.channels import channel_of
from pebble.contract.identity import parse_topic
from pebble.extensions.foxglove.json_channels import json_spec
from pebble.extensions.foxglove.media_feed import MediaFeed
from pebble.extensions.foxglove.server import Server, protobuf_spec
from pebble.extensions.operator.client.broker import Broker
from pebble.extensions.operator.client.media_request.offer import Medium
from pebble.extensions.operator.client.robot_topics import FLEET, SYNONYMS, WATCHED
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.extensions.recordings.exports.foxglove_messages import Schemas, Telemetry, as_object, stamped, time_of
from pebble.transports import Message
from pebble.transports.topics import matches

log = logging.getLogger(__name__)

MOST_ROBOTS: Final = 500  # that are shown; further ones are counted
_MEDIA: Final[tuple[Medium, ...]] = ("video", "audio")


def filters(base: str) -> list[str]:
    """Return topic filters for the telemetry of robots at ``base``, without media. No filter covers another."""
    filters_ = list(dict.fromkeys(channel.filter(base) for channel in (*FLEET, *WATCHED, *SYNONYMS)))

    def is_covered(filter_: str) -> bool:
        return any(wider != filter_ and matches(wider, filter_) for wider in filters_)

    return [filter_ for filter_ in filters_ if not is_covered(filter_)]


class Robots:
    """The robots shown in Foxglove. Used on the event loop only."""

    def __init__(self, broker: Broker, server: Server, schemas: Schemas) -> None:
        self.robots: dict[str, RobotView] = {}
        self._refused = 0  # messages that are no JSON, and those of a robot too many
        self._broker, self._server, self._schemas = broker, server, schemas
        self._telemetry = Telemetry(schemas)
        self._feeds: dict[tuple[str, Medium], MediaFeed] = {}
        self._by_channel: dict[str, MediaFeed] = {}  # by the topic of a Foxglove channel
        self._tasks: set[asyncio.Task[None]] = set()
        # By this the broker chooses the topics of requests for media: some robots require an account's name in them.
        broker.is_named = lambda base: base in self.robots and self.robots[base].named

    @property
    def dropped(self) -> int:
        """Return how many pictures and packets of sound were dropped because they came too fast."""
        return sum(feed.dropped for feed in self._feeds.values())

    @property
    def refused(self) -> int:
        """Return how many payloads could not be shown: not JSON, damaged, or a picture that builds on a missing one."""
        return self._refused + sum(feed.refused for feed in self._feeds.values())

    def receive(self, message: Message, at: float) -> None:
        """Process a message that arrived at ``at`` (monotonic)."""
        address = parse_topic(message.topic)
        if address is None or address.identity.is_server or not message.payload:
            return
        robot = self._robot(address.identity.base)
        if robot is None:
            self._refused += 1
            return
        channel = channel_of(f"{address.direction}/{address.metric}")
        if channel in (AUTONOMY_STATUS, CAPABILITIES, STATUS):
            robot.receive(channel, message, at, time.time())
        if channel is CAPABILITIES:
            for medium in _MEDIA:
                feed = self._feed(robot, medium)
                new_channels = feed.update()
                self._by_channel.update(dict.fromkeys(new_channels, feed))
        at_ns = time.time_ns() - round((time.monotonic() - at) * 1e9)
        self._publish(channel, message, at_ns)
        if channel is AUTONOMY_STATUS:  # also as a sentence for people: that the robot drives by itself
            sentence = msgspec.json.encode({"words": robot.itself})
            self._publish(None, Message(f"{message.topic}/words", sentence, retain=True), at_ns)

    def wake(self, topic: str, *, subscribed: bool) -> None:
        """Note that a client has subscribed to this channel or unsubscribed."""
        feed = self._by_channel.get(topic)
        if feed is not None:
            feed.wake(topic.rpartition("/")[2], subscribed=subscribed)

    async def close(self, timeout: float) -> None:
        """Withdraw all requests."""
        for task in self._tasks:
            task.cancel()
        if self._tasks:
            await asyncio.wait(self._tasks, timeout=timeout)

    def _robot(self, base: str) -> RobotView | None:
        """Return the robot of this base topic; None if there are too many."""
        if base not in self.robots and len(self.robots) < MOST_ROBOTS:
            self.robots[base] = RobotView(base)
        return self.robots.get(base)

    # -- telemetry

    def _publish(self, channel: Channel | None, message: Message, at_ns: int) -> None:
        """Publish in Foxglove's schema if there is one, else as JSON; remember the last value of a state."""
        topic, payload = message.topic, message.payload
        remember = message.retain or (channel is not None and channel.default_retain)
        converted = self._telemetry.convert(topic, payload)
        if converted is not None:
            protobuf, subtopic = converted.message, f"{topic}/{converted.ending}"
            if not self._server.declared(subtopic):
                self._server.declare(protobuf_spec(subtopic, protobuf, self._schemas))
            self._server.publish(subtopic, stamped(protobuf, time_of(payload, at_ns)), at_ns, remember=remember)
            return
        data = as_object(payload)
        if data is None:
            self._refused += 1
            return
        if not self._server.declared(topic):
            self._server.declare(json_spec(topic, channel))
        self._server.publish(topic, data, at_ns, remember=remember)

    # -- pictures and sound

    def _feed(self, robot: RobotView, medium: Medium) -> MediaFeed:
        """Return the feed of this medium, which is made and started at the first call."""
        if (feed := self._feeds.get((robot.base, medium))) is not None:
            return feed
        feed = self._feeds[robot.base, medium] = MediaFeed(self._broker, self._server, self._schemas, robot, medium)
        task = asyncio.create_task(feed.run(), name=f"the {medium} of {robot.base}")
        self._tasks.add(task)
        task.add_done_callback(_log_error)
        return feed


def _log_error(task: asyncio.Task[None]) -> None:
    if not task.cancelled() and task.exception() is not None:
        log.error("%s has ended", task.get_name(), exc_info=task.exception())
