"""A robot's pictures or sound for Foxglove: requested while a client subscribes, converted, and published."""

import asyncio
import logging
import time
from collections import deque
from collections.abc import Callable
from typing import Final, NamedTuple

from pebble.contract import AUDIO, CAMERA
from pebble.errors import PebbleError
from pebble.extensions.foxglove.server import MAX_BYTES, Server, protobuf_spec
from pebble.extensions.media import pyav
from pebble.extensions.media.packets import PBAT
from pebble.extensions.media.picture_header import MAX_PAYLOAD, PictureSequence
from pebble.extensions.operator.client.broker import Broker
from pebble.extensions.operator.client.media_request.offer import Medium, offered, refusal
from pebble.extensions.operator.client.media_request.shared import SharedRequest
from pebble.extensions.operator.client.robot_topics import topic_of
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.extensions.recordings.exports.foxglove_messages import (
    IMAGE,
    SOUND,
    VIDEO,
    Converted,
    Media,
    MediaChannel,
    Schemas,
    is_h264,
    stamped,
    time_of,
)

log = logging.getLogger(__name__)

MAX_WAITING, MAX_WAITING_BYTES = 100, 8 << 20  # payloads received and not yet converted: 2 s of sound
_AS_CONFIGURED: Final = None  # joins what runs already, in whatever encoding
_WITHOUT_PYAV: Final[dict[Medium, tuple[str, ...]]] = {"video": ("pbvd", "json"), "audio": ("pcm",)}
_CHANNEL: Final = {"video": CAMERA, "audio": AUDIO}


class Waiting(NamedTuple):
    """A payload that waits for conversion."""

    payload: bytes
    at_ns: int  # when it was received
    complete: bool  # no picture is missing before it


class MediaFeed:
    """A medium of one robot: the request for it, and its payloads. ``run`` is its task on the event loop.

    Payloads are converted on a thread, a few at a time, because decoding a picture takes milliseconds.
    """

    def __init__(self, broker: Broker, server: Server, schemas: Schemas, robot: RobotView, medium: Medium) -> None:
        self.wants_keyframe = False  # a client has subscribed, or a picture is missing
        self.dropped = 0  # payloads that were too many at once
        self.refused = 0  # those that are nothing of this medium, too large, damaged, or without what they build on
        self.waiting: deque[Waiting] = deque()
        self._waiting_bytes = 0
        self._work = asyncio.Event()
        self._robot, self._medium = robot, medium
        self._server, self._schemas, self._media = server, schemas, Media(schemas)
        self._topic = _CHANNEL[medium].topic(robot.base)  # the robot's; Foxglove's channels are below it
        self._request = SharedRequest(broker, robot.base, medium, self.receive)
        self._sequence = PictureSequence()
        self._arriving = ""  # the encoding of the newest picture
        self._problem = self._reported = ""  # why the newest payload was not published; as shown

    def update(self) -> list[str]:
        """Apply new capabilities; return the channels that they add. Channels are never removed."""
        channels, base = [], self._robot.base
        if not refusal(base, self._robot.capabilities, self._medium):
            self._topic = topic_of(base, self._robot.capabilities, _CHANNEL[self._medium])
            channels = [self._declared(*kind) for kind in self._kinds()]
        self._request.want(self._is_wanted())
        return channels

    def wake(self, ending: str, *, subscribed: bool) -> None:
        """Note that a client has subscribed to the channel with this end of its topic, or unsubscribed."""
        self.wants_keyframe = self.wants_keyframe or (subscribed and ending == VIDEO.ending)
        self._request.want(self._is_wanted())

    async def run(self) -> None:
        """Request and convert until the task is cancelled; then withdraw the request."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._run_requests())
            tasks.create_task(self._run_conversion())

    def receive(self, payload: bytes) -> None:
        """Keep a payload of the robot for conversion, or refuse it."""
        is_readable = self._take_picture(payload) if self._medium == "video" else payload.startswith(PBAT)
        if not is_readable or len(payload) > MAX_PAYLOAD:
            self.refused += 1
            return
        self.waiting.append(Waiting(payload, time.time_ns(), self._sequence.complete))
        self._waiting_bytes += len(payload)
        while len(self.waiting) > MAX_WAITING or self._waiting_bytes > MAX_WAITING_BYTES:
            self._drop()
        self._work.set()

    def _drop(self) -> None:
        """Drop the oldest payload. Of pictures drop all, because each builds on those before it."""
        is_video = self._medium == "video"
        count = len(self.waiting) if is_video else 1
        for _ in range(count):
            self._waiting_bytes -= len(self.waiting.popleft().payload)
        self.dropped += count
        if is_video:
            self._sequence.interrupt()
            self.wants_keyframe = True

    def encoding(self) -> str | None:
        """Return the encoding to request: H.264 if a client subscribes to it, else the robot's configured one.

        Without PyAV it is one that needs no decoding.
        """
        encodings = offered(self._robot.capabilities, self._medium)
        if self._subscribed(VIDEO.ending) and "h264" in encodings:
            return "h264"
        if pyav.installed():
            return _AS_CONFIGURED
        return next((name for name in _WITHOUT_PYAV[self._medium] if name in encodings), _AS_CONFIGURED)

    def _take_picture(self, payload: bytes) -> bool:
        """True if the payload is a picture. If one before it is missing, a key frame is requested."""
        header = self._sequence.take(payload)
        if header is None:
            return False
        if header.keyframe:
            self.wants_keyframe = False
        elif not self._sequence.complete:
            self.wants_keyframe = True
            self._request.wake()
        self._arriving = header.encoding
        return True

    # -- requests

    def _kinds(self) -> tuple[MediaChannel, ...]:
        """Return the Foxglove channels for this medium."""
        if self._medium == "audio":
            return (SOUND,)
        return (VIDEO, IMAGE) if "h264" in offered(self._robot.capabilities, "video") else (IMAGE,)

    def _is_wanted(self) -> bool:
        return any(self._subscribed(channel.ending) for channel in (VIDEO, IMAGE, SOUND))

    def _declared(self, schema: str, ending: str) -> str:
        """Declare a channel if it is new; return its topic."""
        topic = f"{self._topic}/{ending}"
        if not self._server.declared(topic):
            self._server.declare(protobuf_spec(topic, self._schemas.make(schema), self._schemas))
        return topic

    def _subscribed(self, ending: str) -> bool:
        return self._server.subscribed(f"{self._topic}/{ending}")

    async def _run_requests(self) -> None:
        while True:
            await self._request.wait_until_wanted()
            await self._request.run(self._step)
            self._sequence.interrupt()
            self._arriving = ""

    async def _step(self) -> None:
        await self._request.follow(self._robot, self.encoding())
        if not self._is_wanted():
            return
        if not self._request.problem and (self.wants_keyframe or self._decoder_lacks_keyframe()):
            await self._request_keyframe()
        self._report(self._request.problem or self._request.waits or self._why_nothing_is_shown())

    async def _request_keyframe(self) -> None:
        """Request a key frame.

        Not while another encoding still arrives: the requested one begins with a key frame anyway.
        """
        if self._arriving and self._request.encoding in (_AS_CONFIGURED, self._arriving):
            await self._request.request_keyframe(self._arriving)

    def _decoder_lacks_keyframe(self) -> bool:
        return self._subscribed(IMAGE.ending) and self._media.decoder(self._topic).wants_keyframe

    def _report(self, problem: str) -> None:
        """Show a problem in Foxglove, once."""
        if problem and problem != self._reported:
            log.warning("the %s of %s: %s", self._medium, self._robot.base, problem)
            self._server.report(f"{self._topic}: {problem}")
        self._reported = problem

    def _why_nothing_is_shown(self) -> str:
        if self._arriving == "h264" and self._subscribed(IMAGE.ending) and not pyav.installed():
            return f"h264 {pyav.INSTALL}"
        return self._problem

    # -- conversion, on a thread

    async def _run_conversion(self) -> None:
        while True:
            await self._work.wait()
            self._work.clear()
            batch = list(self.waiting)
            self.waiting.clear()
            self._waiting_bytes = 0
            await asyncio.to_thread(self._convert, batch)

    def _convert(self, batch: list[Waiting]) -> None:
        for waiting in batch:
            for convert, ending in self._converters(waiting):
                if self._subscribed(ending):
                    self._publish(convert, waiting)

    def _converters(self, waiting: Waiting) -> list[tuple[Callable[[str, bytes], Converted | None], str]]:
        """Return a converter for each channel that can show this payload, with the end of the channel's topic."""
        if self._medium == "audio":
            return [(self._media.sound, SOUND.ending)]
        image = (self._media.image, IMAGE.ending)
        return [(self._media.video, VIDEO.ending), image] if waiting.complete and is_h264(waiting.payload) else [image]

    def _publish(self, convert: Callable[[str, bytes], Converted | None], waiting: Waiting) -> None:
        try:
            converted, self._problem = convert(self._topic, waiting.payload), ""
        except PebbleError as error:  # Opus without PyAV
            converted, self._problem = None, str(error)
        if converted is None:
            self.refused += 1
            return
        data = stamped(converted.message, time_of(waiting.payload, waiting.at_ns))
        if len(data) > MAX_BYTES:  # the server drops it, and counts that; the problem tells users why they see nothing
            self._problem = f"{len(data)} bytes at once, more than {MAX_BYTES}: reduce size or quality"
        self._server.publish(f"{self._topic}/{converted.ending}", data, waiting.at_ns)
