"""A robot's camera on a network inside the process, and the server's hub of pictures beside it."""

from __future__ import annotations

import asyncio
import json
import struct
import threading
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any, cast

import numpy as np
from starlette.websockets import WebSocket, WebSocketDisconnect

from pebble.client.broker import Broker
from pebble.media.scene import Scene
from pebble.media.video import make_encoder
from pebble.transports import Message, QoS, Transport
from pebble.transports.memory import MemoryHub, MemoryTransport
from pebble.web.media.pictures import MediaHub
from pebble.web.robots import Robots

REF = "pebble/robots/goob"
REQUEST, FLAG = f"{REF}/incoming/front-camera", f"{REF}/incoming/flags/mqtt-video"
CAMERA, CAPABILITIES = f"{REF}/outgoing/front-camera", f"{REF}/outgoing/capabilities"
VIDEO = {
    "available": True,
    "controls": True,
    "topic": CAMERA,
    "command_topic": REQUEST,
    "flag_topic": FLAG,
    "encodings": ["json", "pbvd", "pbvz", "h264"],
}
EVERYTHING = frozenset({"h264", "pbvz", "pbvd", "json", "jpeg"})


def capabilities(video: dict[str, Any]) -> bytes:
    return json.dumps({"t": 1, "schema": "pebble-capabilities/v1", "value": {"video": video}}).encode()


class PictureRobot:
    """Sends a moving scene as requested: its camera runs while the flag is up and a request is active."""

    def __init__(
        self,
        video: dict[str, Any] = VIDEO,
        *,
        fps: float = 15,
        size: tuple[int, int] = (160, 120),
        transport: Transport | None = None,
    ) -> None:
        """``transport``: one that is open; without it on a network of its own, ``hub``."""
        self.hub = MemoryHub()
        self.transport = transport or MemoryTransport("robot", self.hub).open()
        self.published: list[Message] = []  # by others, to the robot
        self.frames = self.bytes = 0
        self.payloads: list[bytes] = []
        self._default = video.get("encoding", "json")
        self._fps, self._size = fps, size
        self._requested = self._flag = False
        self._encoding, self._keyframe = self._default, False
        self._ending = threading.Event()
        self.mute = False
        self.transport.subscribe("#", self._on_message, echo=False, direct=True)
        self.transport.publish(CAPABILITIES, capabilities(video), qos=QoS.DELIVERED, retain=True)
        self._thread = threading.Thread(target=self._film, daemon=True)
        self._thread.start()

    @property
    def requests(self) -> list[dict[str, Any]]:
        return [json.loads(message.payload) for message in self.published if message.topic == REQUEST]

    @property
    def flags(self) -> list[bool]:
        return [json.loads(message.payload)["value"] for message in self.published if message.topic == FLAG]

    def close(self) -> None:
        self._ending.set()
        self._thread.join()
        self.transport.close()

    def send(self, payload: bytes) -> None:
        self.transport.publish(CAMERA, payload)

    def _on_message(self, message: Message) -> None:
        self.published.append(message)
        if message.topic == FLAG:
            self._flag = json.loads(message.payload)["value"]
        elif message.topic == REQUEST:
            request = json.loads(message.payload)
            self._requested = request["enabled"]
            self._encoding = request.get("encoding") or self._default
            self._keyframe = self._keyframe or request.get("keyframe", False)

    def _film(self) -> None:
        scene, picture = Scene(*self._size), np.empty((self._size[1], self._size[0], 3), np.uint8)
        encoder, due = None, time.monotonic()
        while not self._ending.wait(max(0.0, due - time.monotonic())):
            due = max(due + 1 / self._fps, time.monotonic() - 1)
            if not (self._requested and self._flag) or self.mute:
                encoder = None
                continue
            if encoder is None or encoder.name != self._encoding:
                encoder = make_encoder(self._encoding, fps=self._fps, quality=50)
            keyframe, self._keyframe = self._keyframe, False
            scene.render(self.frames, picture)
            payload = encoder.encode(picture, int(time.time() * 1000), keyframe=keyframe)
            self.frames += 1
            self.bytes += len(payload)
            self.payloads.append(payload)
            self.send(payload)


class FakeBroker:
    """The server's connection: as pebble.client.broker.Broker, on the network inside the process."""

    problem = ""

    def __init__(self, hub: MemoryHub) -> None:
        self.transport = MemoryTransport("server", hub).open()
        self.loop = asyncio.get_running_loop()
        self.connected = True


class Page:
    """One page's socket, as MediaHub sees it. It acknowledges each frame unless ``answer`` is None."""

    def __init__(self, answer: int | None = 0) -> None:
        self.answer = answer
        self.frames: list[tuple[int, int, bytes]] = []  # number, kind, body
        self.closed: int | None = None
        self._answers: asyncio.Queue[dict[str, Any]] = asyncio.Queue()

    async def send_bytes(self, data: bytes) -> None:
        if self.closed is not None:
            raise WebSocketDisconnect(self.closed)
        seq, kind = struct.unpack_from(">IB", data)
        self.frames.append((seq, kind, data[5:]))
        if self.answer is not None:
            self.acknowledge(seq, self.answer)

    async def receive(self) -> dict[str, Any]:
        return await self._answers.get()

    async def close(self, code: int, _reason: str = "") -> None:
        self.closed = self.closed or code
        self._answers.put_nowait({"type": "websocket.disconnect"})

    def acknowledge(self, seq: int, what: int) -> None:
        self._answers.put_nowait({"type": "websocket.receive", "bytes": struct.pack(">IB", seq, what)})

    def send_raw(self, data: bytes) -> None:
        self._answers.put_nowait({"type": "websocket.receive", "bytes": data})

    def leave(self) -> None:
        self._answers.put_nowait({"type": "websocket.disconnect"})

    def direct(self) -> list[bytes]:
        return [body for _, kind, body in self.frames if kind == 0]

    def rescued(self) -> list[bytes]:
        return [body[8:] for _, kind, body in self.frames if kind == 1]


class Server:
    """A hub of pictures, with the newest view of the robot."""

    def __init__(self, hub: MemoryHub) -> None:
        self.broker = FakeBroker(hub)
        self.robots = Robots()
        self.media = MediaHub(cast(Broker, self.broker), self.robots)
        self.views: list[Any] = []
        self.tasks: set[asyncio.Task[None]] = set()
        publish = self.robots.set_server_metric

        def record(ref: str, metric: str, value: Any) -> None:
            self.views.append((time.monotonic(), value))
            publish(ref, metric, value)

        self.robots.set_server_metric = record  # type: ignore[method-assign]
        loop = self.broker.loop
        self.broker.transport.subscribe(
            CAPABILITIES,
            lambda message: loop.call_soon_threadsafe(self.robots.receive, message, time.monotonic()),
            direct=True,
        )

    @property
    def view(self) -> Any:
        return self.views[-1][1] if self.views else None

    def open(self, page: Page, can: frozenset[str] = EVERYTHING, ref: str = REF) -> Page:
        self.tasks.add(asyncio.create_task(self.media.serve(cast(WebSocket, page), ref, can)))
        return page

    async def close(self) -> None:
        await self.media.close()
        await asyncio.gather(*self.tasks)
        await asyncio.to_thread(self.broker.transport.close)


@asynccontextmanager
async def serving(robot: PictureRobot) -> AsyncIterator[Server]:
    server = Server(robot.hub)
    try:
        await until(lambda: server.robots.capabilities(REF))
        yield server
    finally:
        await server.close()
        await asyncio.to_thread(robot.close)


async def until(condition: Callable[[], object], timeout: float = 10.0) -> None:
    """Wait until ``condition()`` is true."""
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end, "it did not become true"
        await asyncio.sleep(0.005)
