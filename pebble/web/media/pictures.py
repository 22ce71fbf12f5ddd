"""Robots' pictures for pages: one request per robot, however many pages show it."""

import asyncio
import struct
import time
from typing import Final
from weakref import WeakKeyDictionary

from starlette.websockets import WebSocket, WebSocketDisconnect

from pebble.contract import CAMERA
from pebble.web.media.connection import MediaConnection
from pebble.web.media.picture_stream import PageViewer, PictureStream
from pebble.web.media.rescue import newest_jpeg
from pebble.web.media.stream import Streams
from pebble.web.messages import PictureView
from pebble.web.robots import Robots

PICTURE_METRIC: Final = "web/picture"
_ANSWER: Final = struct.Struct(">IB")  # number of a frame, and what became of it
_SNAPSHOT_S: Final = 0.5  # a snapshot this recent is used again


class MediaHub:
    """All streams of pictures. Only the event loop calls it."""

    def __init__(self, connection: MediaConnection, robots: Robots) -> None:
        self._connection, self._robots = connection, robots
        self._streams = Streams(CAMERA, connection, self._make)
        self._snapshots: WeakKeyDictionary[PictureStream, _Snapshot] = WeakKeyDictionary()

    async def serve(self, websocket: WebSocket, ref: str, can: frozenset[str]) -> None:
        """Send the pictures of ``ref`` to a page that decodes ``can``, until either end closes the socket."""
        viewer = PageViewer(can)
        await self._streams.serve(
            websocket,
            ref,
            viewer,
            lambda _: _send(websocket, viewer),
            lambda stream: _receive(websocket, stream, viewer),
        )

    async def snapshot(self, ref: str) -> bytes | None:
        """The newest picture as a JPEG, if pictures are flowing; it starts no camera."""
        stream = self._streams.get(ref)
        if stream is None:
            return None
        return await self._snapshots.setdefault(stream, _Snapshot()).take(stream)

    async def close(self) -> None:
        """Withdraw all requests."""
        await self._streams.close()

    def _make(self, ref: str) -> PictureStream:
        return PictureStream(self._connection, self._robots, ref, self._show)

    def _show(self, ref: str, view: PictureView) -> None:
        if self._robots.capabilities(ref):
            self._robots.set_server_metric(ref, PICTURE_METRIC, view)


class _Snapshot:
    """The last picture that was taken of one stream, for those who want it at the same time."""

    def __init__(self) -> None:
        self._lock = asyncio.Lock()
        self._taken: bytes | None = None
        self._taken_at = float("-inf")

    async def take(self, stream: PictureStream) -> bytes | None:
        async with self._lock:
            chain = stream.chain()
            if not chain:
                return None
            if time.monotonic() - self._taken_at > _SNAPSHOT_S:
                self._taken = await asyncio.to_thread(newest_jpeg, chain)
                self._taken_at = time.monotonic()
            return self._taken


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
