"""The soundboard as a process of its own, with a simulated loudspeaker, and a client that commands it."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
import wave
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgspec
import numpy as np

from pebble.config import load
from pebble.media.pcm import Samples
from pebble.runtime.connections import hub_settings, local_transport
from pebble.simulation.loudspeaker import Playback, playbacks
from pebble.transports import Message, QoS, State
from tests.support import ROOT, Child, until

RATE = 16_000
LOUDSPEAKER = [sys.executable, "-m", "pebble.simulation.loudspeaker"]
RAW = ["-q", "-t", "raw", "-f", "S16_LE", "-c", "{channels}", "-r", "{rate}", "-D", "{device}", "-"]
#: A player that never ends by itself, and starts at once.
LONG = ["sh", "-c", "exec sleep 60"]


def tone(seconds: float, channels: int = 1, rate: int = RATE) -> Samples:
    """(samples, channels); each channel another tone."""
    times = np.arange(round(seconds * rate)) / rate
    tones = [9000 * np.sin(2 * np.pi * (440 + 220 * channel) * times) for channel in range(channels)]
    return np.stack(tones, axis=1).astype(np.int16)


def write_wav(path: Path, samples: Samples, rate: int = RATE) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with wave.open(str(path), "wb") as file:
        file.setnchannels(samples.shape[1])
        file.setsampwidth(2)
        file.setframerate(rate)
        file.writeframes(samples.astype("<i2").tobytes())
    return path


class Soundboard:
    """``playback`` are keys of services.soundboard_handler.playback; the player records unless they name another."""

    def __init__(self, kind: str, port: int, *, exclusive: bool = False, **playback: Any) -> None:
        self._kind = kind
        self._resources = ExitStack()
        self.folder = Path(tempfile.mkdtemp(prefix="pbl")).resolve()  # short: it holds unix sockets
        self._resources.callback(shutil.rmtree, self.folder, ignore_errors=True)
        self.base = f"pebble/robots/{self.folder.name}"  # of its own: the broker retains what others published
        self.sounds, self.record = self.folder / "sounds", self.folder / "played"
        self.sounds.mkdir()
        self.player = [*LOUDSPEAKER, "--record", str(self.record), *["--exclusive"] * exclusive]
        self._config_file = self._write_config(port, playback)
        self.config = load(self._config_file)
        self.statuses: list[dict[str, Any]] = []
        self.catalogues: list[dict[str, Any]] = []
        self.process: subprocess.Popen[bytes]

    def __enter__(self) -> Self:
        if self._kind == "zenoh":
            self._start("pebble.runtime.hub", msgspec.json.encode(hub_settings(self.config), enc_hook=str).decode())
        self.local = local_transport(self.config, "client").open(10)
        self._resources.callback(self.local.close)
        assert self.local.state is State.CONNECTED, self.local.problem
        self.local.subscribe(f"{self.base}/outgoing/soundboard-status", _appends_to(self.statuses))
        self.local.subscribe(f"{self.base}/outgoing/soundboard-files", _appends_to(self.catalogues))
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._resources.close()

    def start(self) -> Self:
        """Start the service; returns once it has published what it is doing."""
        count = len(self.statuses), len(self.catalogues)
        self.process = self._start("pebble.services.soundboard_handler", str(self._config_file))
        assert until(lambda: len(self.statuses) > count[0] and len(self.catalogues) > count[1], 20)
        return self

    def send(self, body: Any, *, retain: bool = False) -> None:
        raw = json.dumps(body).encode()
        topic = f"{self.base}/incoming/soundboard-command"
        assert until(lambda: self.local.publish(topic, raw, qos=QoS.DELIVERED, retain=retain)), self.local.problem

    def play(self, file: str, **more: Any) -> None:
        self.send({"action": "play", "file": file, **more})

    def became(self, timeout: float = 15.0, **expected: Any) -> bool:
        """Wait until the newest status has these values."""
        return until(lambda: expected.items() <= self.statuses[-1].items(), timeout)

    def refused(self, body: Any) -> str | None:
        """Send it to a soundboard that plays nothing; the error that it publishes."""
        count = len(self.statuses)
        self.send(body)
        assert until(lambda: len(self.statuses) > count), body
        assert not self.statuses[-1]["playing"], body
        error: str | None = self.statuses[-1]["error"]
        return error

    @property
    def files(self) -> list[str]:
        names: list[str] = self.catalogues[-1]["files"]
        return names

    @property
    def played(self) -> list[Playback]:
        return playbacks(self.record)

    def samples(self, number: int = 0) -> Samples:
        one = self.played[number]
        return np.frombuffer(one.frames(), "<i2").reshape(-1, one.channels)

    def hold_loudspeaker(self, path: Path) -> subprocess.Popen[bytes]:
        """Another program plays ``path``."""
        process = Child([*self.player, str(path)], cwd=ROOT)
        self._resources.callback(process.wait, 10)
        self._resources.callback(process.kill)
        assert until(lambda: len(self.played) == 1)
        return process

    def players(self) -> list[int]:
        """The processes that this service has started and that run."""
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split()
        return [int(word) for word in children]

    def _start(self, module: str, argument: str) -> subprocess.Popen[bytes]:
        process = Child([sys.executable, "-m", module, argument], cwd=ROOT)
        self._resources.callback(process.wait, 10)
        self._resources.callback(process.terminate)
        return process

    def _write_config(self, port: int, playback: dict[str, Any]) -> Path:
        (self.folder / "run").mkdir(mode=0o700)
        broker = {"host": "127.0.0.1", "port": port}
        options = {"directory": str(self.sounds), "player_command": self.player, "scan_interval": 1, **playback}
        raw = {
            "robot": {"id": self.folder.name},
            "transport": {"kind": self._kind, "run_dir": str(self.folder / "run")},
            "local_mqtt": broker,
            "services": {
                "mqtt_bridge": {"media": {"audio_receiver": {"command": [*self.player, *RAW]}}},
                "soundboard_handler": {"enabled": True, "playback": options},
            },
        }
        path = self.folder / "robot.json"
        path.write_text(json.dumps(raw))
        return path


def _appends_to(received: list[dict[str, Any]]) -> Any:
    def receive(message: Message) -> None:
        received.append(json.loads(message.payload))

    return receive
