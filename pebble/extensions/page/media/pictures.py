"""Robots' pictures for pages: one request per robot, however many pages show it."""

import struct
import time
from typing import Final

from starlette.websockets import WebSocket, WebSocketDisconnect

from pebble.contract import CAMERA
from pebble.extensions.operator.client.broker import Broker
from pebble.extensions.page.media.picture_stream import PageViewer, PictureStream
from pebble.extensions.page.media.stream import Streams
from pebble.extensions.page.robots import Robots

_ANSWER: Final = struct.Struct(">IB")  # number of a frame, and what became of it


class MediaHub(Streams[PictureStream]):
    """All streams of pictures. Only the event loop calls it."""

    def __init__(self, broker: Broker, robots: Robots) -> None:
        super().__init__(CAMERA, lambda ref: PictureStream(broker, robots, ref))

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

    async def snapshot(self, ref: str) -> bytes | None:
        """Return the newest picture as a JPEG, if pictures are flowing; it starts no camera."""
        stream = self.get(ref)
        return None if stream is None else await stream.snapshot()


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
