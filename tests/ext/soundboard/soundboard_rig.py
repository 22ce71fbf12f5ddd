"""The soundboard as a process of its own, with a simulated loudspeaker, and a client that commands it."""

from __future__ import annotations

import sys
import wave
from pathlib import Path
from typing import Any, Self

import numpy as np

from pebble.extensions.lab.simulation.loudspeaker import Playback, playbacks
from pebble.extensions.media.pcm import Samples
from tests.kit.robot import Program, ProgramRobot
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


class Soundboard(ProgramRobot):
    """``playback`` are keys of services.soundboard_handler.playback; the player records unless they name another."""

    process: Program

    def __init__(self, kind: str, port: int, *, exclusive: bool = False, **playback: Any) -> None:
        super().__init__(kind, port, {})
        self.sounds, self.record = self.folder / "sounds", self.folder / "played"
        self.sounds.mkdir()
        self.player = [*LOUDSPEAKER, "--record", str(self.record), *["--exclusive"] * exclusive]
        options = {"directory": str(self.sounds), "player_command": self.player, **playback}
        self.raw["services"] = {
            "mqtt_bridge": {"media": {"audio_receiver": {"command": [*self.player, *RAW]}}},
            "soundboard_handler": {"enabled": True, "playback": options},
        }
        self.config = self.write()

    def start(self) -> Self:
        """Start the service; returns once it has published what it is doing."""
        count = len(self.statuses), len(self.catalogues)
        self.process = self.run("pebble.services.soundboard_handler.service:SoundboardHandler")
        assert until(lambda: len(self.statuses) > count[0] and len(self.catalogues) > count[1], 20)
        return self

    def with_clip(self, name: str, seconds: float) -> Self:
        """Put a tone into the folder, and start the service."""
        write_wav(self.sounds / name, tone(seconds))
        return self.start()

    def send(self, body: Any) -> None:
        self.world.command("soundboard-command", body)

    def play(self, file: str, **more: Any) -> None:
        self.send({"action": "play", "file": file, **more})

    def became(self, timeout: float = 15.0, **expected: Any) -> bool:
        """Wait until the newest status has these values."""
        return self.world.became("soundboard-status", timeout, **expected)

    def plays(self, file: str, **more: Any) -> bool:
        """Play a clip, and wait until it is over without an error."""
        self.play(file, **more)
        return self.became(playing=True, file=file, error=None) and self.became(playing=False, file=None, error=None)

    def refused(self, body: Any) -> str | None:
        """Send it to a soundboard that plays nothing; the error that it publishes."""
        count = len(self.statuses)
        self.send(body)
        assert until(lambda: len(self.statuses) > count), body
        assert not self.statuses[-1]["playing"], body
        error: str | None = self.statuses[-1]["error"]
        return error

    @property
    def statuses(self) -> list[dict[str, Any]]:
        return self.world.payloads("soundboard-status")

    @property
    def catalogues(self) -> list[dict[str, Any]]:
        return self.world.payloads("soundboard-files")

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

    def hold_loudspeaker(self, path: Path) -> None:
        """Another program plays ``path``."""
        process = Child([*self.player, str(path)], cwd=ROOT)
        self._ends.callback(process.wait, 10)
        self._ends.callback(process.kill)
        assert until(lambda: len(self.played) == 1)

    def players(self) -> list[int]:
        """The processes that this service has started and that run."""
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split()
        return [int(word) for word in children]
