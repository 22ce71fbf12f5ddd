"""examples/gstreamer_sockets.py, fed by a camera and a microphone in this process, and read by Debian's ``shmsrc``."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import threading
import time
from itertools import pairwise
from pathlib import Path
from typing import Any, Self

import numpy as np
import pytest

from pebble.extensions.media.frames import FrameInfo
from pebble.transports.segments import SHM
from tests.ext.av.media_rig import Device
from tests.support import ROOT, WAIT_S, Child, until

#: `make long PART=gstreamer` installs it.
pytestmark = pytest.mark.skipif(shutil.which("gst-launch-1.0") is None, reason="GStreamer is not installed")
EXAMPLE = ROOT / "examples" / "gstreamer_sockets.py"
WIDTH, HEIGHT, RATE = 160, 120, 16_000
CHUNK = RATE // 50


class Camera(Device):
    """Writes pictures all of whose bytes are their number, modulo 251."""

    def __init__(self, folder: Path, size: tuple[int, int] = (WIDTH, HEIGHT)) -> None:
        self.size = size
        super().__init__(folder, "camera", 30, 3 * size[0] * size[1])

    def write(self, number: int) -> None:
        (width, height), now = self.size, time.monotonic_ns()
        info = FrameInfo(captured_ns=now, captured_ms=now // 1_000_000, format="bgr24", width=width, height=height)
        self.writer.write(np.full(3 * width * height, number % 251, np.uint8), info)


class Microphone(Device):
    """Writes 20 ms at a time; each sample is its number."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, "microphone", 50, 2 * CHUNK)

    def write(self, number: int) -> None:
        samples = np.arange(number * CHUNK, (number + 1) * CHUNK).astype("<i2")
        info = FrameInfo(captured_ns=time.monotonic_ns(), format="s16le", rate=RATE, channels=1)
        self.writer.write(samples.view(np.uint8), info)


class Sockets:
    """The example with the config of a robot that names both sockets."""

    def __init__(self, folder: Path, **video: Any) -> None:
        self.run_dir, self.video, self.audio = folder / "run", folder / "video.sock", folder / "audio.sock"
        self._config = folder / "robot.json"
        devices = {
            "enabled": True,
            "video": {"socket_path": str(self.video), "width": WIDTH, "height": HEIGHT, **video},
            "audio": {"socket_path": str(self.audio), "rate": RATE},
        }
        transport = {"kind": "zenoh", "run_dir": str(self.run_dir)}
        config = {"robot": {"id": "rover"}, "transport": transport, "services": {"av_daemon": devices}}
        self._config.write_text(json.dumps(config))
        self.start()

    def start(self) -> None:
        self.process = Child([sys.executable, str(EXAMPLE), str(self._config)], cwd=ROOT, stderr=subprocess.PIPE)
        assert until(lambda: self.video.is_socket() and self.audio.is_socket())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.terminate()
        self.process.wait(WAIT_S)


class Reader:
    """``shmsrc`` in a process of its own, with what a script of the original asks for."""

    def __init__(self, path: Path, caps: str, size: int) -> None:
        self._size, self.frames = size, list[bytes]()
        source = ["shmsrc", f"socket-path={path}", "is-live=true", "do-timestamp=true", "!", caps, "!"]
        command = ["gst-launch-1.0", "-q", *source, "fdsink", "fd=1"]
        self.process = Child(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        while len(data := self.process.stdout.read(self._size)) == self._size:
            self.frames.append(data)

    def gets(self, more: int) -> bool:
        """Wait for so many further frames."""
        wanted = len(self.frames) + more
        return until(lambda: len(self.frames) >= wanted)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait(WAIT_S)


def picture_reader(path: Path, width: int = WIDTH, height: int = HEIGHT) -> Reader:
    caps = f"video/x-raw,format=BGR,width={width},height={height},framerate=15/1"
    return Reader(path, caps, -(-3 * width // 4) * 4 * height)


@pytest.mark.parametrize(
    ("configured", "sent"),
    [
        ({"width": 162, "height": 91}, (162, 91)),
        ({"rotate_degrees": 90}, (HEIGHT, WIDTH)),
    ],
    ids=["rows of 486 bytes", "turned"],
)
def test_pictures(tmp_path: Path, configured: dict[str, int], sent: tuple[int, int]) -> None:
    width, height = sent
    with Sockets(tmp_path, **configured) as sockets, Camera(sockets.run_dir, sent):
        with picture_reader(sockets.video, width, height) as reader:
            assert reader.gets(10)
        stride = -(-3 * width // 4) * 4
        for before, after in pairwise(reader.frames):
            rows = {after[at : at + 3 * width] for at in range(0, len(after), stride)}
            assert rows == {after[:1] * (3 * width)}, "whole"
            assert after[0] != before[0], "and new"


def test_sound(tmp_path: Path) -> None:
    caps = f"audio/x-raw,format=S16LE,rate={RATE},channels=1,layout=interleaved"
    with Sockets(tmp_path) as sockets, Microphone(sockets.run_dir):
        with Reader(sockets.audio, caps, 2 * CHUNK) as reader:
            assert reader.gets(20)
        samples = np.frombuffer(b"".join(reader.frames), "<u2")
        assert set(np.diff(samples)) == {1}, "none is missing"


def test_readers_end_with_it_and_find_the_next_one(tmp_path: Path) -> None:
    before = set(SHM.glob("shmpipe.*"))
    with Sockets(tmp_path) as sockets, Camera(sockets.run_dir):
        with picture_reader(sockets.video) as reader:
            assert reader.gets(5)
            sockets.process.send_signal(signal.SIGKILL)
            assert until(lambda: reader.process.poll() is not None), "scripts open it again"
        sockets.process.wait(WAIT_S)
        left = set(SHM.glob("shmpipe.*")) - before
        assert len(left) <= 1
        for segment in left:
            segment.unlink()
        sockets.start()
        with picture_reader(sockets.video) as again:
            assert again.gets(5)
