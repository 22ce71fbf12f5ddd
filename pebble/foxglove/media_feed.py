"""One medium of one robot for Foxglove: requested while a client subscribes to its channels, converted, published."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections import deque
from collections.abc import Callable
from typing import Any, Final, NamedTuple

from pebble.client.broker import Broker
from pebble.client.media_request.picture_header import PictureHeader, follows, read_header
from pebble.client.media_request.source import MediaSource, offered, refusal
from pebble.client.viewer import Medium
from pebble.contract import AUDIO, CAMERA
from pebble.contract.packets import PBAT
from pebble.errors import PebbleError
from pebble.foxglove.server import MAX_BYTES, Server, protobuf_spec
from pebble.media import pyav
from pebble.recordings.exports.foxglove_messages import (
    IMAGE,
    SOUND,
    VIDEO,
    Converted,
    Media,
    Schemas,
    is_h264,
    stamped,
    time_of,
)

log = logging.getLogger(__name__)

LINGER_S: Final = 5.0  # without subscribers, before the request is withdrawn: as the operator page does
MAX_WAITING, MAX_WAITING_BYTES = 100, 8 << 20  # payloads received and not yet converted: 2 s of sound
MAX_PAYLOAD: Final = 4 << 20
_TICK_S: Final = 0.5
_AS_CONFIGURED: Final = None  # joins what runs already, in whatever encoding
_WITHOUT_PYAV: Final[dict[Medium, tuple[str, ...]]] = {"video": ("pbvz", "pbvd", "json"), "audio": ("pcm",)}
_CHANNEL: Final = {"video": CAMERA, "audio": AUDIO}


class _Waiting(NamedTuple):
    payload: bytes
    at_ns: int  # when it was received
    complete: bool  # no picture is missing before it


class MediaFeed:
    """All but the conversion runs on the event loop; ``run`` is its task."""

    def __init__(self, broker: Broker, server: Server, schemas: Schemas, ref: str, medium: Medium) -> None:
        self.ref, self.medium = ref, medium
        self.dropped = 0  # too many at once
        self.refused = 0  # nothing of this medium, damaged, or without what it builds on
        self._broker, self._server, self._schemas = broker, server, schemas
        self._media = Media(schemas)
        self._source = MediaSource(broker, ref, medium, self.receive)
        self._capabilities: dict[str, Any] = {}
        self._topic = _CHANNEL[medium].topic(ref)
        self._waiting: deque[_Waiting] = deque()
        self._waiting_bytes = 0
        self._wakeup, self._work = asyncio.Event(), asyncio.Event()
        self._wanted_at = float("-inf")
        self._wants_keyframe = False  # a client has subscribed, or a picture is missing
        self._last: PictureHeader | None = None  # of the newest picture, unless one is missing before it
        self._arriving = ""  # the encoding of the newest picture
        self._problem = ""  # as shown
        self._unpublished = ""  # why the newest payload was not

    def update(self, capabilities: dict[str, Any]) -> list[str]:
        """Take new capabilities; returns the channels that it has by them, which stay."""
        self._capabilities = capabilities
        self._wakeup.set()
        if refusal(self.ref, capabilities, self.medium):
            return []
        self._topic = capabilities[self.medium].get("topic") or _CHANNEL[self.medium].topic(self.ref)
        return [self._declare(*kind) for kind in self._kinds()]

    def wake(self, ending: str, *, subscribed: bool) -> None:
        """A client has subscribed, or unsubscribed."""
        self._wants_keyframe = self._wants_keyframe or (subscribed and ending == VIDEO[1])
        self._wakeup.set()

    async def run(self) -> None:
        """Until it is cancelled; then it withdraws its request."""
        try:
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(self._run_requests())
                tasks.create_task(self._run_conversion())
        finally:
            await self._source.withdraw()

    def receive(self, payload: bytes) -> None:
        """A payload of the robot."""
        known = self._take_picture(payload) if self.medium == "video" else payload.startswith(PBAT)
        if not known or len(payload) > MAX_PAYLOAD:
            self.refused += 1
            return
        self._waiting.append(_Waiting(payload, time.time_ns(), self._last is not None))
        self._waiting_bytes += len(payload)
        while len(self._waiting) > MAX_WAITING or self._waiting_bytes > MAX_WAITING_BYTES:
            self._drop()
        self._work.set()

    def _drop(self) -> None:
        """The oldest; of pictures all, because each builds on those before it."""
        count = len(self._waiting) if self.medium == "video" else 1
        for _ in range(count):
            self._waiting_bytes -= len(self._waiting.popleft().payload)
        self.dropped += count
        self._last, self._wants_keyframe = None, self.medium == "video"

    def _take_picture(self, payload: bytes) -> bool:
        """Whether it is a picture. One that is missing before it is noticed, and a key frame wanted."""
        header = read_header(payload)
        if header is None:
            self._last = None
            return False
        complete = follows(self._last, header)
        if header.keyframe:
            self._wants_keyframe = False
        elif not complete:
            self._wants_keyframe = True
            self._wakeup.set()
        self._last, self._arriving = header if complete else None, header.encoding
        return True

    # -- requests

    def _kinds(self) -> tuple[tuple[str, str], ...]:
        if self.medium == "audio":
            return (SOUND,)
        return (VIDEO, IMAGE) if "h264" in offered(self._capabilities, "video") else (IMAGE,)

    def _declare(self, schema: str, ending: str) -> str:
        topic = f"{self._topic}/{ending}"
        if not self._server.declared(topic):
            self._server.declare(protobuf_spec(topic, self._schemas.make(schema), self._schemas))
        return topic

    def _subscribed(self, ending: str) -> bool:
        return self._server.subscribed(f"{self._topic}/{ending}")

    def _wanted(self) -> bool:
        return any(self._subscribed(ending) for _, ending in (VIDEO, IMAGE, SOUND))

    async def _run_requests(self) -> None:
        while True:
            await self._step()
            idle = not self._source.started and not self._wanted()
            with contextlib.suppress(TimeoutError):  # wait_for of Python 3.11 loses a cancellation that meets a wakeup
                async with asyncio.timeout(None if idle else _TICK_S):
                    await self._wakeup.wait()
            self._wakeup.clear()

    async def _step(self) -> None:
        """A request is not withdrawn while there is no broker: the robot would go on sending afterwards."""
        now = time.monotonic()
        if self._wanted():
            self._wanted_at = now
            await self._request()
        elif self._source.started and now - self._wanted_at >= LINGER_S and self._broker.connected:
            await self._source.withdraw()
            self._last, self._arriving = None, ""

    async def _request(self) -> None:
        try:
            if reason := refusal(self.ref, self._capabilities, self.medium):
                raise PebbleError(reason)
            await self._source.follow(self._capabilities, self._encoding())
            if self._wants_keyframe or self._lacks_keyframe():
                await self._request_keyframe()
            self._report(self._why_nothing_is_shown())
        except PebbleError as error:
            await self._source.withdraw()
            self._report(str(error))

    async def _request_keyframe(self) -> None:
        """Not while another encoding still arrives: the one that was requested begins with a key frame."""
        if self._arriving and self._source.encoding in (_AS_CONFIGURED, self._arriving):
            await self._source.request_keyframe(self._arriving)

    def _encoding(self) -> str | None:
        """The encoding to request: H.264 where a client wants it as it is, else what any viewer already gets."""
        known = offered(self._capabilities, self.medium)
        if self._subscribed(VIDEO[1]) and "h264" in known:
            return "h264"
        if pyav.installed():
            return _AS_CONFIGURED
        return next((name for name in _WITHOUT_PYAV[self.medium] if name in known), _AS_CONFIGURED)

    def _lacks_keyframe(self) -> bool:
        return self._subscribed(IMAGE[1]) and self._media.decoder(self._topic).wants_keyframe

    def _why_nothing_is_shown(self) -> str:
        if self._arriving == "h264" and self._subscribed(IMAGE[1]) and not pyav.installed():
            return f"h264 {pyav.INSTALL}"
        return self._unpublished

    def _report(self, problem: str) -> None:
        """Show a new problem in Foxglove, once."""
        if problem and problem != self._problem:
            log.warning("the %s of %s: %s", self.medium, self.ref, problem)
            self._server.report(f"{self._topic}: {problem}")
        self._problem = problem

    # -- conversion

    async def _run_conversion(self) -> None:
        """A few at a time, on a thread: pictures that are decoded take milliseconds."""
        while True:
            await self._work.wait()
            self._work.clear()
            batch = list(self._waiting)
            self._waiting.clear()
            self._waiting_bytes = 0
            await asyncio.to_thread(self._convert, batch)

    def _convert(self, batch: list[_Waiting]) -> None:
        for one in batch:
            for convert, ending in self._converters(one):
                if self._subscribed(ending):
                    self._publish(convert, one)

    def _converters(self, one: _Waiting) -> list[tuple[Callable[[str, bytes], Converted | None], str]]:
        if self.medium == "audio":
            return [(self._media.sound, SOUND[1])]
        image = (self._media.image, IMAGE[1])
        return [(self._media.video, VIDEO[1]), image] if one.complete and is_h264(one.payload) else [image]

    def _publish(self, convert: Callable[[str, bytes], Converted | None], one: _Waiting) -> None:
        try:
            converted, self._unpublished = convert(self._topic, one.payload), ""
        except PebbleError as error:  # Opus without PyAV
            converted, self._unpublished = None, str(error)
        if converted is None:
            self.refused += 1
            return
        data = stamped(converted.message, time_of(one.payload, one.at_ns))
        if len(data) > MAX_BYTES:
            self._unpublished = f"{len(data)} bytes at once, more than {MAX_BYTES}: reduce size or quality"
        self._server.publish(f"{self._topic}/{converted.ending}", data, one.at_ns)
