"""A microphone in this process, one media program in its own, a stand-in for aplay, and an operator who listens."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgspec

from pebble.config import Config, load
from pebble.links import hub_settings, local_transport
from pebble.media.sound import Heard, SoundDecoder
from pebble.media.speech import Speech
from pebble.payloads import MediaReport
from pebble.transports import Message, MqttSettings, QoS, State, Transport, create
from pebble.transports.frames import FrameInfo, FrameWriter
from tests.support import ROOT, die_with_parent, until

BASE = "pebble/robots/rover"
CHUNK_MS = 20

# Appends what it hears to a file that is named after how it was called.
RECORDER = """
import os, sys, time
folder, rate, channels, device = sys.argv[1:]
with open(f"{folder}/{time.monotonic_ns():020}-{rate}-{channels}-{device}-{os.getpid()}.raw", "wb", buffering=0) as out:
    while chunk := os.read(0, 4096):
        out.write(chunk)
"""


class Mouth:
    """Says the speech into the microphone's stream, 20 ms at a time, while anybody listens."""

    def __init__(self, folder: Path, rate: int = 16000, channels: int = 1) -> None:
        self.speech, self.rate, self.channels = Speech(rate, channels), rate, channels
        self._count = rate * CHUNK_MS // 1000
        self.writer = FrameWriter(folder, "microphone", capacity=self._count * 2 * channels, slots=16)
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
        began, number = time.monotonic(), 0
        while not self._stopping.wait(max(0.0, began + number * CHUNK_MS / 1000 - time.monotonic())):
            number += 1
            info = FrameInfo(
                captured_ns=time.monotonic_ns(),
                captured_ms=time.time_ns() // 1_000_000,
                format="s16le",
                rate=self.rate,
                channels=self.channels,
            )
            if self.writer.wanted:
                self.writer.write(self.speech.samples((number - 1) * self._count, self._count).tobytes(), info)


class Ear:
    """An operator who decodes every packet of the robot's sound."""

    def __init__(self, port: int) -> None:
        self.transport = client("ear", port)
        self.heard: list[Heard] = []
        self.arrived: list[float] = []  # epoch seconds
        self.decoder = SoundDecoder()
        self.transport.subscribe(f"{BASE}/outgoing/audio", self._listen, qos=QoS.LATEST)

    def close(self) -> None:
        self.transport.close()

    def wait(self, count: int, timeout: float = 20.0) -> list[Heard]:
        """Until so many packets more have come; returns these."""
        before = len(self.heard)
        assert until(lambda: len(self.heard) >= before + count, timeout), f"{len(self.heard) - before} packets came"
        return self.heard[before:]

    def wait_for(self, encoding: str) -> None:
        assert until(lambda: bool(self.heard) and self.heard[-1].encoding == encoding, 20), f"no {encoding} came"

    def _listen(self, message: Message) -> None:
        one = self.decoder.feed(message.payload)
        if one is not None:
            self.arrived.append(time.time())
            self.heard.append(one)


class Program:
    """``python -m pebble.services.<name>`` of a robot with ``kind`` inside, and what it reports there."""

    def __init__(self, name: str, kind: str, local_port: int, remote_port: int, **options: Any) -> None:
        self.name, self._kind, self._ports, self._options = name, kind, (local_port, remote_port), options
        self._ends = ExitStack()
        self.reports: list[MediaReport] = []
        self.process: subprocess.Popen[bytes]

    def __enter__(self) -> Self:
        self.folder = Path(tempfile.mkdtemp(prefix="pbl"))  # short: it holds unix sockets
        self._ends.callback(shutil.rmtree, self.folder, ignore_errors=True)
        self.config = self._write_config()
        if self._kind == "zenoh":
            self._start("pebble.hub", msgspec.json.encode(hub_settings(self.config), enc_hook=str).decode())
        self.local = local_transport(self.config, "somebody").open(10)
        self._ends.callback(self.local.close)
        assert self.local.state is State.CONNECTED, self.local.problem
        self.local.subscribe(f"{BASE}/outgoing/media-report/{self.name}", self._note)
        self.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._ends.close()

    def start(self) -> None:
        self.process = self._start(f"pebble.services.{self.name}", str(self.config.path))

    @property
    def run_dir(self) -> Path:
        return self.config.run_dir()

    def ask(self, **request: Any) -> None:
        """What the bridge passes on from operators."""
        body = json.dumps({"enabled": True, **request}).encode()
        assert self.local.publish(f"{BASE}/incoming/audio", body, qos=QoS.DELIVERED)

    @property
    def newest(self) -> MediaReport:
        """The last report; before the first one, one that says nothing."""
        return self.reports[-1] if self.reports else MediaReport(running=False)

    def reported(self, timeout: float = 15.0, **expected: Any) -> bool:
        """Until the newest report says so."""

        return until(lambda: all(getattr(self.newest, name) == value for name, value in expected.items()), timeout)

    def _note(self, message: Message) -> None:
        self.reports.append(msgspec.json.decode(message.payload, type=MediaReport))

    def _start(self, module: str, argument: str) -> subprocess.Popen[bytes]:
        process = subprocess.Popen([sys.executable, "-m", module, argument], cwd=ROOT, preexec_fn=die_with_parent)
        self._ends.callback(process.wait, 10)
        self._ends.callback(process.terminate)
        return process

    def _write_config(self) -> Config:
        run_dir = self.folder / "run"
        run_dir.mkdir(mode=0o700)
        local, remote = self._ports
        bridge = {
            "enabled": True,
            "remote_mqtt": {"host": "127.0.0.1", "port": remote},
            "media": {self.name: self._options},
        }
        raw = {
            "robot": {"id": "rover"},
            "transport": {"kind": self._kind, "run_dir": str(run_dir)},
            "local_mqtt": {"host": "127.0.0.1", "port": local},
            "services": {"mqtt_bridge": bridge},
        }
        path = self.folder / "robot.json"
        path.write_text(json.dumps(raw))
        return load(path)


def client(name: str, port: int) -> Transport:
    transport = create("mqtt", name, MqttSettings(host="127.0.0.1", port=port, silence_s=10)).open(10)
    assert transport.state is State.CONNECTED, transport.problem
    return transport
