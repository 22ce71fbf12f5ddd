"""Robots' pictures for pages: one request per robot, however many pages show it, and a still of each."""

import asyncio
import struct
import time
from contextlib import suppress
from typing import Final, NamedTuple

import msgspec
from starlette.websockets import WebSocket, WebSocketDisconnect

from pebble.contract import CAMERA, MEDIA_STATUS
from pebble.extensions.operator.client.broker import Broker
from pebble.extensions.operator.client.media_request.offer import BEST_FIRST, refusal
from pebble.extensions.page.media import rescue
from pebble.extensions.page.media.picture_stream import PageViewer, PictureStream
from pebble.extensions.page.media.stream import Streams
from pebble.extensions.page.robots import Robots

_ANSWER: Final = struct.Struct(">IB")  # number of a frame, and what became of it
_MOST_STILLS: Final = 200  # of cameras that rest; the oldest goes
_FRESH_S: Final = 4.5  # of a camera that is on, no still is older: key frames come each 4 s
_GLIMPSE_S: Final = 6.0  # until a camera sends a key frame


class Still(NamedTuple):
    """A picture as a JPEG, and when it came, monotonic."""

    jpeg: bytes
    at: float


class _Reports(msgspec.Struct):
    """A media status, as far as it is needed here."""

    class Program(msgspec.Struct):
        running: bool = False

    camera_publisher: Program = msgspec.field(default_factory=Program)


_reports = msgspec.json.Decoder(_Reports)


class MediaHub(Streams[PictureStream]):
    """All streams of pictures. Only the event loop calls it."""

    def __init__(self, broker: Broker, robots: Robots) -> None:
        super().__init__(CAMERA, lambda ref: PictureStream(broker, robots, ref))
        self._robots = robots
        self._last: dict[str, tuple[bytes, float]] = {}  # key frames of streams that have ended
        self._taking: dict[str, asyncio.Task[Still | None]] = {}

    async def serve(self, websocket: WebSocket, ref: str, can: frozenset[str]) -> None:
        """Send the pictures of ``ref`` to a page that decodes ``can``, until either end closes the socket."""
        viewer = PageViewer(can)
        await self.let_view(
            websocket,
            ref,
            viewer,
            lambda _: _send(websocket, viewer),
            lambda stream: _receive(websocket, stream, viewer),
        )

    async def snapshot(self, ref: str) -> Still | None:
        """Return the newest picture, of a camera that rests its last one; it starts no camera."""
        if ref not in self._taking:
            self._taking[ref] = task = asyncio.create_task(self._take(ref))
            task.add_done_callback(lambda _: self._taking.pop(ref, None))
        return await asyncio.shield(self._taking[ref])

    async def look_in_turn(self) -> None:
        """Switch on one camera after another for a moment, while a page shows the fleet."""
        while True:
            await asyncio.sleep(1.0)
            for ref in list(self._robots.components):
                if self._robots.shows_fleet and not refusal(ref, self._robots.capabilities(ref), "video"):
                    await self._glimpse(ref)
                    await asyncio.sleep(1.0)

    async def _take(self, ref: str) -> Still | None:
        if self._is_on(ref) and not self._has_fresh(ref):
            await self._glimpse(ref)
        key = self._key(ref)
        jpeg = None if key is None else await asyncio.to_thread(rescue.newest_jpeg, [key[0]])
        return None if key is None or jpeg is None else Still(jpeg, key[1])

    def _key(self, ref: str) -> tuple[bytes, float] | None:
        stream = self.get(ref)
        return (None if stream is None else stream.key) or self._last.get(ref)

    def _is_on(self, ref: str) -> bool:
        """True if the camera sends pictures, to any program."""
        raw = self._robots.value(ref, MEDIA_STATUS.metric)
        with suppress(msgspec.MsgspecError):
            return raw is not None and _reports.decode(raw).camera_publisher.running
        return False

    def _has_fresh(self, ref: str) -> bool:
        key = self._key(ref)
        return key is not None and time.monotonic() - key[1] < _FRESH_S

    async def _glimpse(self, ref: str) -> None:
        """Look at a robot's camera, as a page would, until there is a picture."""
        viewer = PageViewer(frozenset(name for name in BEST_FIRST["video"] if not rescue.unavailable(name)))
        stream, end = self._open(ref), time.monotonic() + _GLIMPSE_S
        stream.join(viewer)
        try:
            while not self._has_fresh(ref) and not stream.task.done() and time.monotonic() < end:
                await asyncio.sleep(0.1)
        finally:
            stream.leave(viewer)

    def _forget(self, ref: str, task: asyncio.Task[None]) -> None:
        if (key := self._key(ref)) is not None:
            self._last.pop(ref, None)
            self._last[ref] = key
        if len(self._last) > _MOST_STILLS:
            del self._last[next(iter(self._last))]
        super()._forget(ref, task)


async def _send(websocket: WebSocket, viewer: PageViewer) -> None:
    try:
        while True:
            frame = viewer.queue.take(time.monotonic())
            if frame is None:
                await viewer.wakeup.wait()
                viewer.wakeup.clear()
            else:
                await websocket.send_bytes(frame.data)
    except (WebSocketDisconnect, RuntimeError, OSError):  # RuntimeError: it is closed
        return


async def _receive(websocket: WebSocket, stream: PictureStream, viewer: PageViewer) -> None:
    """Take the page's answers until it leaves, or sends what is none."""
    while True:
        message = await websocket.receive()
        answer = message.get("bytes")
        if message["type"] != "websocket.receive" or answer is None or len(answer) != _ANSWER.size:
            return
        stream.acknowledge(viewer, *_ANSWER.unpack(answer))
