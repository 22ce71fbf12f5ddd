"""Robots' pictures for pages, by one request for each robot however many pages show it, and stills."""

import asyncio
import struct
import time
from typing import Final

import msgspec
from starlette.websockets import WebSocket, WebSocketDisconnect

from pebble.contract import CAMERA, MEDIA_STATUS
from pebble.extensions.operator.client.broker import Broker
from pebble.extensions.operator.client.media_request.offer import BEST_FIRST, refusal
from pebble.extensions.page.media import rescue
from pebble.extensions.page.media.picture_stream import KeyFrame, PageViewer, PictureStream
from pebble.extensions.page.media.stream import Streams
from pebble.extensions.page.robots import Robots

_ANSWER: Final = struct.Struct(">IB")  # of a page: the number of a frame, and an answer of PictureStream
_MOST_STILLS: Final = 200  # of cameras that rest; the oldest goes
_FRESH_S: Final = 4.5  # of a camera that is on, no still is older: key frames come each 4 s
_GLIMPSE_S: Final = 6.0  # so long a still is waited for
_TURN_S: Final = 5.0  # until the next camera's turn


class MediaHub(Streams[PictureStream]):
    """All picture streams. Used on the event loop only."""

    def __init__(self, broker: Broker, robots: Robots) -> None:
        super().__init__(CAMERA, lambda ref: PictureStream(broker, robots, ref))
        self._robots = robots
        self._last: dict[str, KeyFrame] = {}  # of streams that have ended
        self._looking: dict[str, asyncio.Task[None]] = {}  # tasks that fetch a still

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

    async def snapshot(self, ref: str) -> tuple[bytes, float] | None:
        """Return the camera's newest key frame as JPEG, however old, with its time (monotonic); None without one.

        It starts no camera, and never waits: if the camera is on and the key frame is old, a new one is fetched for the
        next call.
        """
        reports = self._robots.value(ref, MEDIA_STATUS.metric)
        is_on = reports is not None and msgspec.json.decode(reports).get("camera_publisher", {}).get("running", False)
        if is_on and not self._has_fresh(ref) and ref not in self._looking:
            self._looking[ref] = asyncio.create_task(self._glimpse(ref))
        key = self._key(ref)
        if key is None:
            return None
        jpeg = await asyncio.to_thread(rescue.jpeg_of, key.payload)
        return None if jpeg is None else (jpeg, key.received_at)

    async def look_in_turn(self) -> None:
        """Turn on one camera after another for a moment, while a page shows the fleet."""
        while True:
            await asyncio.sleep(1.0)
            for ref in list(self._robots.components):
                # A page that has no robot open shows the fleet.
                shows_fleet = any(not interest.watched for interest in self._robots.interests)
                if shows_fleet and not refusal(ref, self._robots.capabilities(ref), "video"):
                    await self._glimpse(ref)
                    await asyncio.sleep(_TURN_S)

    def _key(self, ref: str) -> KeyFrame | None:
        stream = self.get(ref)
        return stream.key if stream is not None and stream.key is not None else self._last.get(ref)

    def _has_fresh(self, ref: str) -> bool:
        key = self._key(ref)
        return key is not None and time.monotonic() - key.received_at < _FRESH_S

    async def _glimpse(self, ref: str) -> None:
        """Request a robot's pictures, as a page would, until there is one."""
        viewer = PageViewer(frozenset(name for name in BEST_FIRST["video"] if not rescue.unavailable(name)))
        stream, end = self._open(ref), time.monotonic() + _GLIMPSE_S
        stream.join(viewer)
        try:
            while not self._has_fresh(ref) and not stream.task.done() and time.monotonic() < end:
                await asyncio.sleep(0.1)
        finally:
            stream.leave(viewer)
            self._looking.pop(ref, None)

    def _forget(self, ref: str, task: asyncio.Task[None]) -> None:
        """Forget a stream that has ended, but keep its last key frame."""
        if (key := self._key(ref)) is not None:
            self._last.pop(ref, None)  # so that it is the newest in the table
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
    """Handle the page's answers until it closes the socket, or sends an invalid one."""
    while True:
        message = await websocket.receive()
        answer = message.get("bytes")
        if message["type"] != "websocket.receive" or answer is None or len(answer) != _ANSWER.size:
            return
        stream.acknowledge(viewer, *_ANSWER.unpack(answer))
