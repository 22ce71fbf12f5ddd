"""A robot's microphone and loudspeaker on a network inside the process, and the server's hub of sound beside it."""

from __future__ import annotations

import asyncio
import json
import struct
import threading
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any, cast

from starlette.websockets import WebSocket, WebSocketDisconnect

from pebble.client.broker import Broker
from pebble.contract.packets import Sound
from pebble.fleet.roles import Role, Session
from pebble.media.sound import make_sound_encoder
from pebble.media.speech import Speech
from pebble.transports import Message, QoS, Transport
from pebble.transports.memory import MemoryHub, MemoryTransport
from pebble.web.media.sound import SoundHub
from pebble.web.robots import Robots
from tests.web.picture_robot import FakeBroker, until

REF = "pebble/robots/goob"
REQUEST, FLAG, UPLINK = f"{REF}/incoming/audio", f"{REF}/incoming/flags/mqtt-audio", f"{REF}/incoming/audio-stream"
SOUND, CAPABILITIES = f"{REF}/outgoing/audio", f"{REF}/outgoing/capabilities"
AUDIO = {
    "available": True,
    "controls": True,
    "topic": SOUND,
    "uplink_topic": UPLINK,
    "command_topic": REQUEST,
    "flag_topic": FLAG,
    "encodings": ["pcm", "opus"],
}
BOTH, PLAIN, NOTHING = frozenset({"opus", "pcm"}), frozenset({"pcm"}), frozenset[str]()
RATE, PIECE = 16_000, 320

__all__ = ["until"]


def capabilities(audio: dict[str, Any]) -> bytes:
    return json.dumps({"t": 1, "schema": "pebble-capabilities/v1", "value": {"audio": audio}}).encode()


class SoundRobot:
    """Speaks as requested: while the flag is up and a request is active."""

    def __init__(self, audio: dict[str, Any] = AUDIO, transport: Transport | None = None) -> None:
        """``transport``: one that is open; without it on a network of its own, ``hub``."""
        self.hub = MemoryHub()
        self.transport = transport or MemoryTransport("robot", self.hub).open()
        self.published: list[Message] = []  # by others, to the robot
        self.sent: list[bytes] = []
        self.voice: list[Sound] = []
        self.mute = False
        self._default = audio.get("encoding", "pcm")
        self._encoding = self._default
        self._requested = self._flag = False
        self._ending = threading.Event()
        self.transport.subscribe("#", self._on_message, echo=False, direct=True)
        self.transport.publish(CAPABILITIES, capabilities(audio), qos=QoS.DELIVERED, retain=True)
        self._thread = threading.Thread(target=self._speak, daemon=True)
        self._thread.start()

    @property
    def requests(self) -> list[dict[str, Any]]:
        return [json.loads(message.payload) for message in list(self.published) if message.topic == REQUEST]

    @property
    def encodings(self) -> list[str | None]:
        """Those that were requested, None for an end; repetitions left out."""
        named = [one.get("encoding") if one["enabled"] else None for one in self.requests]
        return [name for index, name in enumerate(named) if not index or name != named[index - 1]]

    @property
    def flags(self) -> list[bool]:
        return [json.loads(message.payload)["value"] for message in list(self.published) if message.topic == FLAG]

    def close(self) -> None:
        self._ending.set()
        self._thread.join()
        self.transport.close()

    def send(self, payload: bytes) -> None:
        self.transport.publish(SOUND, payload)

    def _on_message(self, message: Message) -> None:
        self.published.append(message)
        if message.topic == FLAG:
            self._flag = json.loads(message.payload)["value"]
        elif message.topic == REQUEST:
            request = json.loads(message.payload)
            self._requested = request["enabled"]
            self._encoding = request.get("encoding") or self._default
        elif message.topic == UPLINK:
            self.voice.append(Sound.unpack(message.payload))

    def _speak(self) -> None:
        speech, encoder, due, first = Speech(RATE), None, time.monotonic(), 0
        while not self._ending.wait(max(0.0, due - time.monotonic())):
            due = max(due + PIECE / RATE, time.monotonic() - 1)
            if not (self._requested and self._flag) or self.mute:
                encoder = None
                continue
            if encoder is None or encoder.name != self._encoding:
                encoder = make_sound_encoder(self._encoding, rate=RATE, channels=1)
            pcm = speech.samples(first, PIECE).tobytes()
            first += PIECE
            for payload in encoder.encode(pcm, int(1000 * time.time())):
                self.sent.append(payload)
                self.send(payload)


class _Broker(FakeBroker):
    def publish(self, topic: str, payload: bytes, *, retain: bool = False, qos: QoS = QoS.DELIVERED) -> bool:
        return self.transport.publish(topic, payload, qos=qos, retain=retain)


class Page:
    """One page's socket, as SoundHub sees it. It acknowledges what it receives while ``answers`` is true."""

    def __init__(self, *, answers: bool = True) -> None:
        self.answers = answers
        self.packets: list[bytes] = []
        self.talks: list[dict[str, Any]] = []
        self.closed: int | None = None
        self._sent: asyncio.Queue[dict[str, Any]] = asyncio.Queue()

    async def send_bytes(self, data: bytes) -> None:
        if self.closed is not None:
            raise WebSocketDisconnect(self.closed)
        self.packets.append(data)
        if self.answers:
            self.acknowledge(len(self.packets))

    async def send_text(self, text: str) -> None:
        self.talks.append(json.loads(text))

    async def receive(self) -> dict[str, Any]:
        return await self._sent.get()

    async def close(self, code: int, _reason: str = "") -> None:
        self.closed = self.closed or code
        self._sent.put_nowait({"type": "websocket.disconnect"})

    def leave(self) -> None:
        self._sent.put_nowait({"type": "websocket.disconnect"})

    def send(self, data: bytes) -> None:
        self._sent.put_nowait({"type": "websocket.receive", "bytes": data})

    def acknowledge(self, count: int) -> None:
        self.send(struct.pack(">BI", 0, count))

    def send_piece(self, talk: int, number: int, pcm: bytes) -> None:
        self.send(struct.pack(">BII", 1, talk, number) + pcm)

    def end(self, talk: int) -> None:
        self.send(struct.pack(">BI", 2, talk))

    async def speak(self, talk: int, pieces: int, *, until_refused: bool = True) -> bytes:
        """Speak so long in real time; returns the samples."""
        speech, sent, began = Speech(RATE), b"", time.monotonic()
        for number in range(pieces):
            pcm = speech.samples(PIECE * number, PIECE).tobytes()
            self.send_piece(talk, number, pcm)
            sent += pcm
            await asyncio.sleep(max(0.0, began + (number + 1) * PIECE / RATE - time.monotonic()))
            if until_refused and any(one["talk"] == talk and not one["on"] for one in self.talks):
                break
        return sent


class Server:
    """A hub of sound, with the newest view of the robot."""

    def __init__(self, hub: MemoryHub) -> None:
        self.broker = _Broker(hub)
        self.robots = Robots()
        self.noted: list[tuple[str, str]] = []
        self.sound = SoundHub(
            cast(Broker, self.broker), self.robots, lambda ref, session, *_: self.noted.append((ref, session.user))
        )
        self.view: Any = None
        self.tasks: set[asyncio.Task[None]] = set()
        publish = self.robots.set_server_metric

        def record(ref: str, metric: str, value: Any) -> None:
            self.view = value
            publish(ref, metric, value)

        self.robots.set_server_metric = record  # type: ignore[method-assign]
        loop = self.broker.loop

        def learn(message: Message) -> None:
            loop.call_soon_threadsafe(self.robots.receive, message, time.monotonic())

        self.broker.transport.subscribe(CAPABILITIES, learn, direct=True)

    def open(
        self, page: Page, can: frozenset[str] = BOTH, *, user: str = "alice", role: Role = Role.DRIVER, ref: str = REF
    ) -> Page:
        session = Session(user, user, role)
        self.tasks.add(asyncio.create_task(self.sound.serve(cast(WebSocket, page), ref, can, session)))
        return page

    async def close(self) -> None:
        await self.sound.close()
        await asyncio.gather(*self.tasks)
        await asyncio.to_thread(self.broker.transport.close)


@asynccontextmanager
async def serving(robot: SoundRobot) -> AsyncIterator[Server]:
    server = Server(robot.hub)
    try:
        await until(lambda: server.robots.capabilities(REF))
        yield server
    finally:
        await server.close()
        await asyncio.to_thread(robot.close)
