"""A media program as a process of its own, a device in this process, and an operator at a broker.

And for av_daemon: a writer that only remembers, and configs of one device.
"""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from functools import cache
from pathlib import Path
from types import SimpleNamespace, TracebackType
from typing import Any, Self

import msgspec
import numpy as np

from pebble.contract.payloads import MediaReport
from pebble.extensions.media.decode import VideoDecoder
from pebble.extensions.media.frames import FrameInfo, FrameWriter
from pebble.extensions.media.sound import SoundDecoder
from pebble.extensions.media.speech import Speech
from pebble.services.av_daemon.config import AvDaemon
from pebble.services.av_daemon.source import Source
from pebble.transports import Message, MqttSettings, QoS, State, Transport, create
from pebble.transports.counters import Counters
from tests.kit.robot import BASE as BASE
from tests.kit.robot import ROBOT, SILENCE_S, Program, ProgramRobot
from tests.support import WAIT_S, until

WIDTH, HEIGHT = 320, 240


class MediaProgram(ProgramRobot):
    """The service called ``name`` of a robot, and what it reports inside.

    ``section`` of services.mqtt_bridge.media holds the ``options``; operators' requests come on ``request``.
    """

    process: Program

    def __init__(
        self, name: str, section: str, request: str, local_port: int, remote_port: int, **options: Any
    ) -> None:
        remote = {"host": "127.0.0.1", "port": remote_port, "silence_seconds": SILENCE_S}
        bridge = {"enabled": True, "remote_mqtt": remote, "media": {section: options}}
        super().__init__("mqtt", local_port, {"mqtt_bridge": bridge}, robot=ROBOT)
        self.name, self._request, self.run_dir = name, request, self.config.run_dir()

    def __enter__(self) -> Self:
        self.process = self.run(f"pebble.services.{self.name}.service:{self.name.title().replace('_', '')}")
        return self

    def ask(self, **request: Any) -> None:
        """What the bridge passes on from operators."""
        self.world.command(self._request, {"enabled": True, **request})

    @property
    def reports(self) -> list[MediaReport]:
        found = self.world.on(f"media-report/{self.name}")
        return [msgspec.json.decode(message.payload, type=MediaReport) for message in found]

    @property
    def newest(self) -> MediaReport:
        """The last report; before the first one, one that says nothing."""
        return [MediaReport(running=False), *self.reports][-1]

    def reported(self, timeout: float = WAIT_S, **expected: Any) -> bool:
        """Until the newest report says so."""
        return until(lambda: all(getattr(self.newest, name) == value for name, value in expected.items()), timeout)


def client(name: str, port: int) -> Transport:
    transport = create("mqtt", name, MqttSettings(host="127.0.0.1", port=port, silence_s=SILENCE_S)).open(WAIT_S)
    assert transport.state is State.CONNECTED, transport.problem
    return transport


class Device(ABC):
    """A camera or a microphone: writes into its stream ``hertz`` times a second, while anybody reads."""

    def __init__(self, folder: Path, stream: str, hertz: float, capacity: int, **options: Any) -> None:
        self.writer, self._hertz = FrameWriter(folder, stream, capacity=capacity, **options), hertz
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Self:
        self.writer.open()
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._stopping.set()
        self._thread.join(WAIT_S)
        self.writer.close()

    @abstractmethod
    def write(self, number: int) -> None:
        """Write what is due at that number; they are counted from 1, also while there is no reader."""

    def _run(self) -> None:
        began, number = time.monotonic(), 0
        while not self._stopping.wait(max(0.0, began + number / self._hertz - time.monotonic())):
            number += 1
            if self.writer.wanted:
                self.write(number)


class Filming(Device):
    """A camera of one colour."""

    def __init__(self, folder: Path) -> None:
        self._picture = np.full((HEIGHT, WIDTH, 3), (10, 20, 30), np.uint8)
        super().__init__(folder, "camera", 50, self._picture.size)

    def write(self, number: int) -> None:
        info = FrameInfo(format="bgr24", width=WIDTH, height=HEIGHT, captured_ns=time.monotonic_ns())
        self.writer.write(b"no picture", FrameInfo(format="text"))
        self.writer.write(self._picture, info)


class Operator:
    """Decodes every packet of one topic of the robot."""

    def __init__(self, port: int, metric: str, decoder: VideoDecoder | SoundDecoder) -> None:
        self.transport, self.decoder = client(f"operator-{metric}", port), decoder
        self.received: list[Any] = []  # what was decoded
        self.arrived: list[float] = []  # and when each of it came, epoch seconds
        self.transport.subscribe(f"{BASE}/outgoing/{metric}", self._receive, qos=QoS.LATEST)

    def wait(self, count: int, timeout: float = WAIT_S) -> list[Any]:
        """Until so many packets more have come; returns these."""
        before = len(self.received)
        came = until(lambda: len(self.received) >= before + count, timeout)
        assert came, f"{len(self.received) - before} packets came"
        return self.received[before:]

    def wait_for(self, encoding: str) -> None:
        assert until(lambda: bool(self.received) and self.received[-1].encoding == encoding), f"no {encoding} came"

    def _receive(self, message: Message) -> None:
        decoded = self.decoder.feed(message.payload)
        if decoded is not None:
            self.arrived.append(time.time())
            self.received.append(decoded)


def options(*, video: dict[str, Any] | None = None, audio: dict[str, Any] | None = None, **more: Any) -> AvDaemon:
    return msgspec.convert({"video": video or {}, "audio": audio or {}, **more}, AvDaemon)


def grabbed(source: Source) -> tuple[FrameInfo, np.ndarray]:
    """The next frame of a source."""
    capture = source.grab()
    return capture.info, capture.pixels(np.empty(capture.size, np.uint8)).copy()


speech_of = cache(Speech)


class Remembering:
    """A FrameWriter without memory to share; ``born`` says whether frames may be born in it."""

    def __init__(self, *, wanted: bool = True, born: bool = True) -> None:
        self.counters = Counters()
        self.problem = ""
        self.wanted = wanted
        self.frames: list[tuple[FrameInfo, np.ndarray]] = []
        self.threads: set[int] = set()
        self._born = born

    @property
    def readers(self) -> int:
        return int(self.wanted)

    def write(self, data: np.ndarray, info: FrameInfo) -> bool:
        self.threads.add(threading.get_ident())
        self.frames.append((info, data.copy()))
        return True

    def slot(self, size: int) -> Any:
        if not self._born:
            return None
        array = np.full(size, 255, np.uint8)

        def send(info: FrameInfo) -> bool:
            self.counters.add("born")
            return self.write(array, info)

        return SimpleNamespace(array=array, send=send)
