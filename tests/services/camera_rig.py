"""A camera in this process, the publisher in its own, and an operator who looks at what comes."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgspec
import numpy as np

from pebble.config import Config, load
from pebble.links import hub_settings, local_transport
from pebble.media.decode import VideoDecoder
from pebble.media.scene import Scene, read_counter
from pebble.payloads import MediaReport
from pebble.transports import Message, MqttSettings, QoS, State, Transport, create
from pebble.transports.frames import FrameInfo, FrameWriter
from tests.support import ROOT, die_with_parent, until

BASE = "pebble/robots/rover"
_SILENCE_S = 10.0  # a machine that does too much at once is not a broker that stopped answering


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
        self.transport.subscribe(f"{BASE}/outgoing/front-camera", self._look, qos=QoS.LATEST)

    def wait(self, count: int, timeout: float = 20.0) -> list[Seen]:
        """Until so many pictures more have come; returns these."""
        before = len(self.seen)
        assert until(lambda: len(self.seen) >= before + count, timeout), f"{len(self.seen) - before} pictures came"
        return self.seen[before:]

    def wait_for(self, encoding: str) -> Seen:
        assert until(lambda: bool(self.seen) and self.seen[-1].encoding == encoding, 20), f"no {encoding} came"
        return next(picture for picture in reversed(self.seen) if picture.encoding == encoding)

    def _look(self, message: Message) -> None:
        self.sizes.append(len(message.payload))
        picture = self.decoder.feed(message.payload)
        if picture is None or picture.captured_ms is None:
            return
        number = read_counter(picture.picture)
        now_ms = time.time_ns() // 1_000_000
        self.seen.append(
            Seen(now_ms, picture.captured_ms, number, picture.encoding, picture.keyframe, picture.picture.shape)
        )


class Publisher:
    """`python -m pebble.services.camera_publisher` of a robot with ``kind`` inside, and what it reports there."""

    def __init__(self, kind: str, local_port: int, remote_port: int, **video: Any) -> None:
        self._ends = ExitStack()
        self.folder = Path(tempfile.mkdtemp(prefix="pbl"))  # short: it holds unix sockets
        self._ends.callback(shutil.rmtree, self.folder, ignore_errors=True)
        self.config = self._write_config(kind, local_port, remote_port, video)
        self.reports: list[MediaReport] = []
        self.hub: subprocess.Popen[bytes] | None = None
        self.process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        if self.config.transport.kind == "zenoh":
            settings = msgspec.json.encode(hub_settings(self.config), enc_hook=str).decode()
            self._start("pebble.hub", settings)
        self.local = local_transport(self.config, "somebody").open(10)
        self._ends.callback(self.local.close)
        assert self.local.state is State.CONNECTED, self.local.problem
        topic = f"{BASE}/outgoing/media-report/camera_publisher"
        self.local.subscribe(topic, lambda message: self.reports.append(_report(message.payload)))
        self.process = self._start("pebble.services.camera_publisher", str(self.config.path))
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._ends.close()

    @property
    def run_dir(self) -> Path:
        return self.config.run_dir()

    def ask(self, **request: Any) -> None:
        """What the bridge passes on from operators."""
        body = json.dumps({"enabled": True, **request}).encode()
        topic = f"{BASE}/incoming/front-camera"
        assert until(lambda: self.local.publish(topic, body, qos=QoS.DELIVERED)), self.local.problem

    def reported(self, timeout: float = 15.0, **expected: Any) -> bool:
        """Until the newest report says so."""

        def agrees() -> bool:
            newest = self.reports[-1] if self.reports else None
            return newest is not None and all(getattr(newest, name) == value for name, value in expected.items())

        return until(agrees, timeout)

    def _start(self, module: str, argument: str) -> subprocess.Popen[bytes]:
        process = subprocess.Popen([sys.executable, "-m", module, argument], cwd=ROOT, preexec_fn=die_with_parent)
        self._ends.callback(process.wait, 10)
        self._ends.callback(process.terminate)
        return process

    def _write_config(self, kind: str, local_port: int, remote_port: int, video: dict[str, Any]) -> Config:
        run_dir = self.folder / "run"
        run_dir.mkdir(mode=0o700)
        bridge = {
            "enabled": True,
            "remote_mqtt": {"host": "127.0.0.1", "port": remote_port, "silence_seconds": _SILENCE_S},
            "media": {"video_publisher": video},
        }
        raw = {
            "robot": {"id": "rover"},
            "transport": {"kind": kind, "run_dir": str(run_dir)},
            "local_mqtt": {"host": "127.0.0.1", "port": local_port, "silence_seconds": _SILENCE_S},
            "services": {"mqtt_bridge": bridge},
        }
        path = self.folder / "robot.json"
        path.write_text(json.dumps(raw))
        return load(path)


def client(name: str, port: int) -> Transport:
    transport = create("mqtt", name, MqttSettings(host="127.0.0.1", port=port, silence_s=_SILENCE_S)).open(10)
    assert transport.state is State.CONNECTED, transport.problem
    return transport


def _report(payload: bytes) -> MediaReport:
    return msgspec.json.decode(payload, type=MediaReport)
