"""A camera in this process, the publisher in its own, and an operator who looks at what comes."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pebble.extensions.media.decode import VideoDecoder
from pebble.extensions.media.frames import FrameInfo
from pebble.extensions.media.scene import Scene
from pebble.transports import Message
from tests.ext.av.media_rig import Device, MediaProgram, Operator
from tests.kit.scene import read_counter


class Camera(Device):
    """Writes the scene at ``fps``."""

    def __init__(self, folder: Path, fps: float, size: tuple[int, int] = (320, 240)) -> None:
        self.numbers: dict[int, int] = {}  # of frames, by when they were captured (epoch milliseconds)
        self._scene, (self._width, self._height) = Scene(*size), size
        self._out = np.zeros((self._height, self._width, 3), np.uint8)
        super().__init__(folder, "camera", fps, self._out.size)

    def write(self, number: int) -> None:
        self._scene.render(number, self._out)
        stamp = time.time_ns() // 1_000_000
        self.numbers[stamp] = number
        form = {"format": "bgr24", "width": self._width, "height": self._height}
        self.writer.write(self._out, FrameInfo(captured_ns=time.monotonic_ns(), captured_ms=stamp, **form))


@dataclass(frozen=True)
class Seen:
    """A picture at the operator; times are epoch milliseconds."""

    arrived_ms: int
    captured_ms: int
    number: int | None
    encoding: str
    keyframe: bool
    shape: tuple[int, ...]


class Viewer(Operator[Seen]):
    """Decodes every picture, and reads its number."""

    def __init__(self, port: int) -> None:
        self.decoder = VideoDecoder()
        super().__init__(port, "front-camera")

    def receive(self, message: Message) -> None:
        one = self.decoder.feed(message.payload)
        if one is not None and one.captured_ms is not None:
            now_ms, number, shape = time.time_ns() // 1_000_000, read_counter(one.picture), one.picture.shape
            self.received.append(Seen(now_ms, one.captured_ms, number, one.encoding, one.keyframe, shape))


class Publisher(MediaProgram):
    def __init__(self, kind: str, local_port: int, remote_port: int, **video: Any) -> None:
        super().__init__("camera_publisher", "video_publisher", "front-camera", kind, local_port, remote_port, **video)
