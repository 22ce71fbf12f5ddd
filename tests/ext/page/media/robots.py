"""A robot's camera or microphone on a network inside the process, and the page server's hubs of media beside it."""

from __future__ import annotations

import asyncio
import itertools
import json
import struct
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import AsyncIterator, Callable, Iterable
from contextlib import asynccontextmanager
from typing import Any, ClassVar, cast

import numpy as np
from starlette.websockets import WebSocket, WebSocketDisconnect

from pebble.extensions.fleet.roles import Role, Session
from pebble.extensions.media.packets import Sound
from pebble.extensions.media.scene import Scene
from pebble.extensions.media.sound import make_sound_encoder
from pebble.extensions.media.speech import Speech
from pebble.extensions.media.video import make_encoder
from pebble.extensions.operator.client.broker import Broker
from pebble.extensions.operator.client.media_request.offer import Medium
from pebble.extensions.page.media.pictures import MediaHub
from pebble.extensions.page.media.sound import SoundHub
from pebble.extensions.page.robots import Robots
from pebble.transports import Message, MqttSettings, QoS, Transport
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.support import WAIT_S

REF = "pebble/robots/goob"
CAPABILITIES = f"{REF}/outgoing/capabilities"
CAMERA, SOUND, UPLINK = f"{REF}/outgoing/front-camera", f"{REF}/outgoing/audio", f"{REF}/incoming/audio-stream"


def _section(topic: str, metric: str, flag: str, *encodings: str) -> dict[str, Any]:
    """Return the section of the capabilities about a medium."""
    topics = {"command_topic": f"{REF}/incoming/{metric}", "flag_topic": f"{REF}/incoming/flags/{flag}"}
    return {"available": True, "controls": True, "topic": topic, "encodings": [*encodings], **topics}


VIDEO = _section(CAMERA, "front-camera", "mqtt-video", "json", "pbvd", "h264")
AUDIO = _section(SOUND, "audio", "mqtt-audio", "pcm", "opus") | {"uplink_topic": UPLINK}
EVERYTHING = frozenset({"h264", "pbvd", "json", "jpeg", "opus", "pcm"})
RATE, PIECE = 16_000, 320


class MediaRobot(ABC):
    """Sends one medium as requested: while its flag is up and a request is active."""

    medium: ClassVar[Medium]
    section: ClassVar[dict[str, Any]]

    def __init__(
        self, section: dict[str, Any] | None, period_s: float, default: str, transport: Transport | None
    ) -> None:
        """Begin to send. ``transport``: an open one; without it on a network of its own, ``hub``."""
        given = self.section if section is None else section
        self.hub = MemoryHub()
        self.transport = transport or MemoryTransport("robot", self.hub).open()
        self.request, self.flag = self.section["command_topic"], self.section["flag_topic"]
        self.published: list[Message] = []  # by others, to the robot
        self.sent: list[bytes] = []
        self.mute = False
        self._period_s, self._default = period_s, given.get("encoding", default)
        self._requested = self._raised = self._keyframe = False
        self._encoding = self._default
        self._ending = threading.Event()
        self.transport.subscribe("#", self.receive, echo=False, direct=True)
        self.announce(given)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def requests(self) -> list[dict[str, Any]]:
        return [json.loads(message.payload) for message in list(self.published) if message.topic == self.request]

    @property
    def encodings(self) -> list[str | None]:
        """Those that were requested, None for the end: without key frames, and without repetitions."""
        ends = [request for request in self.requests if not request.get("keyframe")]
        named = [request.get("encoding", "") if request["enabled"] else None for request in ends]
        return [name for name, _ in itertools.groupby(named)]

    @property
    def flags(self) -> list[bool]:
        return [json.loads(message.payload)["value"] for message in list(self.published) if message.topic == self.flag]

    def announce(self, section: dict[str, Any]) -> None:
        self.transport.publish(CAPABILITIES, capabilities(section, self.medium), qos=QoS.DELIVERED, retain=True)

    def send(self, payload: bytes) -> None:
        self.transport.publish(self.section["topic"], payload)

    def close(self) -> None:
        self._ending.set()
        self._thread.join()
        self.transport.close()

    def receive(self, message: Message) -> None:
        self.published.append(message)
        if message.topic == self.flag:
            self._raised = json.loads(message.payload)["value"]
        elif message.topic == self.request:
            request = json.loads(message.payload)
            self._requested = request["enabled"]
            self._encoding = request.get("encoding") or self._default
            self._keyframe = self._keyframe or request.get("keyframe", False)

    def _run(self) -> None:
        encoder, due = None, time.monotonic()
        while not self._ending.wait(max(0.0, due - time.monotonic())):
            due = max(due + self._period_s, time.monotonic() - 1)
            if not (self._requested and self._raised) or self.mute:
                encoder = None
                continue
            if encoder is None or encoder.name != self._encoding:
                encoder = self._make_encoder(self._encoding)
            for payload in self._encode(encoder):
                self.sent.append(payload)
                self.send(payload)

    @abstractmethod
    def _make_encoder(self, name: str) -> Any: ...

    @abstractmethod
    def _encode(self, encoder: Any) -> Iterable[bytes]: ...


class PictureRobot(MediaRobot):
    """Films a moving scene."""

    medium, section = "video", VIDEO

    def __init__(
        self, video: dict[str, Any] | None = None, *, fps: float = 15, size: Any = (160, 120), transport: Any = None
    ) -> None:
        self._fps, self._scene = fps, Scene(*size)
        self._picture = np.empty((size[1], size[0], 3), np.uint8)
        super().__init__(video, 1 / fps, "json", transport)

    def _make_encoder(self, name: str) -> Any:
        return make_encoder(name, fps=self._fps, quality=50)

    def _encode(self, encoder: Any) -> Iterable[bytes]:
        keyframe, self._keyframe = self._keyframe, False
        self._scene.render(len(self.sent), self._picture)
        return [encoder.encode(self._picture, int(time.time() * 1000), keyframe=keyframe)]


class SoundRobot(MediaRobot):
    """Speaks, and keeps what it hears."""

    medium, section = "audio", AUDIO

    def __init__(self, audio: dict[str, Any] | None = None, *, transport: Transport | None = None) -> None:
        self.voice: list[Sound] = []
        self._speech, self._first = Speech(RATE), 0
        super().__init__(audio, PIECE / RATE, "pcm", transport)

    def receive(self, message: Message) -> None:
        super().receive(message)
        if message.topic == UPLINK:
            self.voice.append(Sound.unpack(message.payload))

    def _make_encoder(self, name: str) -> Any:
        return make_sound_encoder(name, rate=RATE, channels=1)

    def _encode(self, encoder: Any) -> Iterable[bytes]:
        pcm = self._speech.samples(self._first, PIECE).tobytes()
        self._first += PIECE
        return list(encoder.encode(pcm, int(1000 * time.time())))


def status_of(camera: str) -> bytes:
    """What a robot publishes of the program that sends its pictures."""
    return json.dumps({"t": 1, "value": {"services": {"camera_publisher": {"state": camera}}}}).encode()


def capabilities(section: dict[str, Any], medium: Medium = "video") -> bytes:
    return json.dumps({"t": 1, "schema": "pebble-capabilities/v1", "value": {medium: section}}).encode()


class Page:
    """A page's socket, as the hubs see it. It acknowledges what it receives if it ``answers``."""

    def __init__(self, *, answers: bool = True) -> None:
        self.answers = answers
        self.received: list[bytes] = []
        self.talks: list[dict[str, Any]] = []
        self.closed: int | None = None
        self._sent: asyncio.Queue[dict[str, Any]] = asyncio.Queue()

    async def send_bytes(self, data: bytes) -> None:
        if self.closed is not None:
            raise WebSocketDisconnect(self.closed)
        self.received.append(data)
        if self.answers:
            self.take(data)

    def take(self, data: bytes) -> None:
        """Acknowledge what was received."""

    async def send_text(self, text: str) -> None:
        self.talks.append(json.loads(text))

    async def receive(self) -> dict[str, Any]:
        return await self._sent.get()

    async def close(self, code: int, _reason: str = "") -> None:
        self.closed = self.closed or code
        self.leave()

    def leave(self) -> None:
        self._sent.put_nowait({"type": "websocket.disconnect"})

    def send(self, data: bytes) -> None:
        self._sent.put_nowait({"type": "websocket.receive", "bytes": data})


class PicturePage(Page):
    """Looks, and draws everything, or answers ``what``."""

    what = 0

    @property
    def frames(self) -> list[tuple[int, int, bytes]]:
        """Number, kind and body of each."""
        return [(*struct.unpack_from(">IB", data), data[5:]) for data in self.received]

    def take(self, data: bytes) -> None:
        self.acknowledge(struct.unpack_from(">I", data)[0], self.what)

    def acknowledge(self, seq: int, what: int) -> None:
        """Acknowledge a picture. ``what``: 0 it is drawn, 1 a key frame is wanted."""
        self.send(struct.pack(">IB", seq, what))

    def direct(self) -> list[bytes]:
        return [body for _, kind, body in self.frames if kind == 0]

    def rescued(self) -> list[bytes]:
        return [body[8:] for _, kind, body in self.frames if kind == 1]


class SoundPage(Page):
    """Listens, and talks."""

    def take(self, data: bytes) -> None:
        self.send(struct.pack(">BI", 0, len(self.received)))

    def send_piece(self, talk: int, number: int, pcm: bytes) -> None:
        self.send(struct.pack(">BII", 1, talk, number) + pcm)

    def end(self, talk: int) -> None:
        self.send(struct.pack(">BI", 2, talk))

    async def speak(self, talk: int, pieces: int) -> bytes:
        """Speak so long in real time; returns the samples."""
        speech, sent, began = Speech(RATE), b"", time.monotonic()
        for number in range(pieces):
            pcm = speech.samples(PIECE * number, PIECE).tobytes()
            self.send_piece(talk, number, pcm)
            sent += pcm
            await asyncio.sleep(max(0.0, began + (number + 1) * PIECE / RATE - time.monotonic()))
            if any(one["talk"] == talk and not one["on"] for one in self.talks):
                break
        return sent


def broker_on(hub: MemoryHub, name: str = "server") -> Broker:
    """The server's connection to the network inside the process; it is not open yet."""
    broker = Broker(MqttSettings(host="127.0.0.1"))
    broker.transport = MemoryTransport(name, hub)
    return broker


class Server:
    """The hubs of pictures and sound, with what they show of the robot."""

    def __init__(self, hub: MemoryHub) -> None:
        self.fleet, self.broker = broker_on(hub), broker_on(hub, "media")
        self.subscribed: list[str] = []
        subscribe = self.broker.transport.subscribe

        def noted(filter_: str, *args: Any, **options: Any) -> Any:
            self.subscribed.append(filter_)
            return subscribe(filter_, *args, **options)

        self.broker.transport.subscribe = noted  # type: ignore[method-assign]
        self.robots = Robots()
        self.noted: list[tuple[str, str]] = []  # who talked
        self.media = MediaHub(self.broker, self.robots)
        self.sound = SoundHub(self.broker, self.robots, lambda ref, who, *_: self.noted.append((ref, who.user)))
        self.view: Any = None  # the newest state that pages are shown
        self._tasks: set[asyncio.Task[None]] = set()
        publish = self.robots.set_server_metric

        def record(ref: str, metric: str, value: Any) -> None:
            self.view = value
            publish(ref, metric, value)

        self.robots.set_server_metric = record  # type: ignore[method-assign]

    def shows(self, state: str) -> bool:
        return self.view is not None and self.view.state == state

    def open(self, page: Page, can: frozenset[str] = EVERYTHING, *, user: str = "alice") -> Any:
        """Let the page look or listen; returns it."""
        socket = cast(WebSocket, page)
        if isinstance(page, SoundPage):
            serving = self.sound.serve(socket, REF, can, Session(user, user, Role.DRIVER))
        else:
            serving = self.media.serve(socket, REF, can)
        self._tasks.add(asyncio.create_task(serving))
        return page

    async def close(self) -> None:
        await self.media.close()
        await self.sound.close()
        await asyncio.gather(*self._tasks)
        await self.broker.close()
        await self.fleet.close()


@asynccontextmanager
async def serving(robot: MediaRobot) -> AsyncIterator[Server]:
    server = Server(robot.hub)
    await server.fleet.open()
    await server.broker.open()
    await server.fleet.subscribe(CAPABILITIES, server.robots.receive)
    try:
        await until(lambda: server.robots.capabilities(REF))
        yield server
    finally:
        await server.close()
        await asyncio.to_thread(robot.close)


async def until(condition: Callable[[], object], timeout: float = WAIT_S) -> None:
    """Wait until ``condition()`` is true."""
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end, "it did not become true"
        await asyncio.sleep(0.005)
