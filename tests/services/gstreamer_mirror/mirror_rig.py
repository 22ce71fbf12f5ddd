"""The mirror as a process of its own, a camera and a microphone in this one, and GStreamer's own programs."""

from __future__ import annotations

import shutil
import subprocess
import threading
import time
from pathlib import Path
from typing import Any, Self

import msgspec
import numpy as np
import pytest

from pebble.contract.payloads import MediaReport
from pebble.transports.frames import FrameInfo
from tests.kit.robot import Program, ProgramRobot
from tests.services.media_rig import Device
from tests.support import Child, until

#: `make long PART=gstreamer` and `make test THOROUGH=1` install it.
needs_gstreamer = pytest.mark.skipif(shutil.which("gst-launch-1.0") is None, reason="GStreamer is not installed")
WIDTH, HEIGHT, RATE = 160, 120, 16_000
CHUNK = RATE // 50


class Camera(Device):
    """Writes pictures all of whose bytes are their number, modulo 251, as its ``size`` is now."""

    def __init__(self, folder: Path, fps: float = 30, size: tuple[int, int] = (WIDTH, HEIGHT)) -> None:
        self.size = size
        self.pausing = threading.Event()
        super().__init__(folder, "camera", fps, 3 * size[0] * size[1])

    def write(self, number: int) -> None:
        if self.pausing.is_set():
            return
        (width, height), now = self.size, time.monotonic_ns()
        info = FrameInfo(captured_ns=now, captured_ms=now // 1_000_000, format="bgr24", width=width, height=height)
        self.writer.write(np.full(3 * width * height, number % 251, np.uint8), info)


class Microphone(Device):
    """Writes 20 ms at a time; each sample is its number."""

    def __init__(self, folder: Path) -> None:
        self.rate = RATE
        super().__init__(folder, "microphone", 50, 2 * CHUNK)

    def write(self, number: int) -> None:
        samples = np.arange(number * CHUNK, (number + 1) * CHUNK).astype("<i2")
        info = FrameInfo(captured_ns=time.monotonic_ns(), format="s16le", rate=self.rate, channels=1)
        self.writer.write(samples.view(np.uint8), info)


class Mirror(ProgramRobot):
    """The service of a robot whose config names both sockets."""

    process: Program

    def __init__(self, port: int, **video: Any) -> None:
        size = {"width": WIDTH, "height": HEIGHT}
        super().__init__("mqtt", port, {})
        self.video, self.audio = self.folder / "video.sock", self.folder / "audio.sock"
        self.raw["services"] = {
            "av_daemon": {
                "enabled": True,
                "video": {"socket_path": str(self.video), **size, **video},
                "audio": {"socket_path": str(self.audio), "rate": RATE},
            }
        }
        self.config = self.write()
        self.start()

    def start(self) -> None:
        self.process = self.run("pebble.services.gstreamer_mirror")

    def newest(self, name: str = "video") -> MediaReport:
        """Its last report on that socket; before the first, one that says nothing."""
        found = self.world.on(f"media-report/gstreamer_mirror:{name}")
        reports = [msgspec.json.decode(message.payload, type=MediaReport) for message in found]
        return [MediaReport(running=False), *reports][-1]


class Reader:
    """Debian's ``shmsrc`` in a process of its own, with what a script of the original asks for."""

    def __init__(self, path: Path, caps: str, size: int, queue: str = "") -> None:
        self._size, self.frames = size, list[bytes]()
        source = ["shmsrc", f"socket-path={path}", "is-live=true", "do-timestamp=true", "!", caps]
        self.process = Child(
            ["gst-launch-1.0", "-q", *source, "!", *queue.split(), "fdsink", "fd=1"],
            stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        while len(data := self.process.stdout.read(self._size)) == self._size:
            self.frames.append(data)

    def gets(self, more: int, timeout: float = 15.0) -> bool:
        """Wait for so many further frames."""
        wanted = len(self.frames) + more
        return until(lambda: len(self.frames) >= wanted, timeout)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait(10)


def picture_reader(path: Path, width: int = WIDTH, height: int = HEIGHT, fps: int = 15) -> Reader:
    """A reader of pictures; each of its rows ends at a multiple of four bytes, as in GStreamer everywhere."""
    caps = f"video/x-raw,format=BGR,width={width},height={height},framerate={fps}/1"
    return Reader(path, caps, -(-3 * width // 4) * 4 * height)


def sound_reader(path: Path, rate: int = RATE) -> Reader:
    caps = f"audio/x-raw,format=S16LE,rate={rate},channels=1,layout=interleaved"
    return Reader(path, caps, 2 * CHUNK)
