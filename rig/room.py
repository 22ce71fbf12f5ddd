"""Where Goob lives: a room with a tag on each wall; and a clip that Goob can play."""

from __future__ import annotations

import json
import math
import wave
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np

from pebble.media.world.world_file import read_world

TAG_ID, TAG_SIZE_M = 21, 0.25  # of the tag that Goob follows, as in the world file
CLIP, CLIP_S = "horn.wav", 1.0
#: Further clips: the tones of each in Hz, and how long one lasts.
_SIGNALS = {
    "signals/beep.wav": ((880.0,), 0.15),
    "signals/fanfare.wav": ((392.0, 523.3, 659.3, 784.0), 0.2),
    "signals/two-tone.wav": ((440.0, 587.3) * 3, 0.4),
}
_RATE = 16_000
#: After the first round of driving Goob looks at that tag, and has space for further rounds wherever it is then.
_START = {"goob": {"kind": "goob", "x": -0.3, "y": 0.2, "heading_deg": 0.0}}


@dataclass(frozen=True, slots=True)
class Outcome:
    """The true state at the end, known to the world and the loudspeaker."""

    distance_m: float  # between camera and tag
    bearing_rad: float  # of the tag, positive to the left
    played_s: float
    clip_s: float


class Room:
    """The world file that comes with Pebble, with Goob alone in it, written to ``folder``."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "room.json"
        room = json.loads((files("pebble.simulation.world") / "room.json").read_text())
        self.path.write_text(json.dumps(room | {"robots": _START}, indent=1))
        self._tag = next(tag for tag in read_world(self.path).tags if tag.id == TAG_ID)

    def tag_from(self, x_m: float, y_m: float, heading_rad: float) -> tuple[float, float]:
        """Distance and bearing (positive to the left) of the tag from a camera at this place."""
        dx, dy = self._tag.x - x_m, self._tag.y - y_m
        return math.hypot(dx, dy), math.remainder(math.atan2(dy, dx) - heading_rad, math.tau)


def write_clip(folder: Path) -> bytes:
    """A horn in ``folder``, which is created, and some signals; returns the samples of the horn."""
    (folder / "signals").mkdir(parents=True)
    for name, (tones, seconds) in _SIGNALS.items():
        _write(folder / name, b"".join(_sound(seconds, tone) for tone in tones))
    horn = _sound(CLIP_S, 440.0, 554.4)
    _write(folder / CLIP, horn)
    return horn


def _sound(seconds: float, *tones: float) -> bytes:
    phases = 2 * np.pi * np.outer(tones, np.arange(round(seconds * _RATE)) / _RATE)
    return bytes((np.sin(phases).sum(axis=0) * 8000).astype("<i2"))


def _write(path: Path, samples: bytes) -> None:
    with wave.open(str(path), "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(2)
        file.setframerate(_RATE)
        file.writeframes(samples)
