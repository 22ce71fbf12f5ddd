"""A camera in this process, the publisher in its own, and an operator who looks at what comes."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from pebble.media.decode import VideoDecoder
from pebble.media.scene import Scene, read_counter
from pebble.transports import Message, QoS
from pebble.transports.frames import FrameInfo, FrameWriter
from tests.services.media_rig import BASE, MediaProgram, client
from tests.support import until


class Camera:
    """Writes the scene at ``fps``, while anybody reads."""

    def __init__(self, folder: Path, fps: float, size: tuple[int, int] = (320, 240)) -> None:
        self.fps = fps
        self.numbers: dict[int, int] = {}  # of frames, by when they were captured (epoch milliseconds)
        self._scene, (width, height) = Scene(*size), size
        self._out = np.zeros((height, width, 3), np.uint8)
        self.writer = FrameWriter(folder, "camera", capacity=self._out.size)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Self:
        self.writer.open()
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._stopping.set()
        self._thread.join(10)
        self.writer.close()

    def _run(self) -> None:
        height, width, _ = self._out.shape
        began, number = time.monotonic(), 0
        while not self._stopping.wait(max(0.0, began + number / self.fps - time.monotonic())):
            number += 1
            if not self.writer.wanted:
                continue
            self._scene.render(number, self._out)
            stamp = time.time_ns() // 1_000_000
            self.numbers[stamp] = number
            info = FrameInfo(
                captured_ns=time.monotonic_ns(), captured_ms=stamp, format="bgr24", width=width, height=height
            )
            self.writer.write(self._out, info)


@dataclass(frozen=True)
class Seen:
    """A picture at the operator; times are epoch milliseconds."""

    arrived_ms: int
    captured_ms: int
    number: int | None
    encoding: str
    keyframe: bool
    shape: tuple[int, ...]


class Viewer:
    """An operator who decodes every picture, and reads its number."""

    def __init__(self, port: int) -> None:
        self.transport = client("viewer", port)
        self.seen: list[Seen] = []
        self.sizes: list[int] = []
        self.decoder = VideoDecoder()
        self.transport.subscribe(f"{BASE}/outgoing/front-camera", self._check, qos=QoS.LATEST)

    def wait(self, count: int, timeout: float = 20.0) -> list[Seen]:
        """Until so many pictures more have come; returns these."""
        before = len(self.seen)
        assert until(lambda: len(self.seen) >= before + count, timeout), f"{len(self.seen) - before} pictures came"
        return self.seen[before:]

    def wait_for(self, encoding: str) -> Seen:
        assert until(lambda: bool(self.seen) and self.seen[-1].encoding == encoding, 20), f"no {encoding} came"
        return next(picture for picture in reversed(self.seen) if picture.encoding == encoding)

    def _check(self, message: Message) -> None:
        self.sizes.append(len(message.payload))
        picture = self.decoder.feed(message.payload)
        if picture is None or picture.captured_ms is None:
            return
        number = read_counter(picture.picture)
        now_ms = time.time_ns() // 1_000_000
        self.seen.append(
            Seen(now_ms, picture.captured_ms, number, picture.encoding, picture.keyframe, picture.picture.shape)
        )


class Publisher(MediaProgram):
    def __init__(self, kind: str, local_port: int, remote_port: int, **video: Any) -> None:
        super().__init__("camera_publisher", "video_publisher", "front-camera", kind, local_port, remote_port, **video)
