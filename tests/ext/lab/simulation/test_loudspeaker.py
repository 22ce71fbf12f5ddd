"""The loudspeaker in software, as a process that is called as aplay is."""

from __future__ import annotations

import subprocess
import sys
import wave
from pathlib import Path
from typing import Any

import pytest

from pebble.extensions.lab.simulation.loudspeaker import playbacks
from tests.support import Child

RATE = 8000
COMMAND = [sys.executable, "-m", "pebble.simulation.loudspeaker"]


def samples(seconds: float, channels: int = 1) -> bytes:
    count = round(seconds * RATE) * channels
    return b"".join((number % 4000).to_bytes(2, "little") for number in range(count))


def clip(folder: Path, seconds: float) -> Path:
    path = folder / "clip.wav"
    with wave.open(str(path), "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(2)
        file.setframerate(RATE)
        file.writeframes(samples(seconds))
    return path


def loudspeaker(folder: Path, *arguments: str, **options: Any) -> Child:
    return Child([*COMMAND, "--record", str(folder), *arguments], **options)


def test_a_file_is_played_in_real_time_and_recorded(tmp_path: Path) -> None:
    path, folder = clip(tmp_path, 0.3), tmp_path / "played"
    assert loudspeaker(folder, str(path)).wait(20) == 0
    (played,) = playbacks(folder)
    assert (played.file, played.rate, played.channels, played.seconds) == (str(path), RATE, 1, 0.3)
    assert not played.stopped
    assert played.frames() == samples(0.3)
    assert played.ended_ns is not None
    assert played.ended_ns - played.began_ns >= 0.15e9, "a busy machine may make up for 0.1 s"


@pytest.mark.parametrize("content", [b"", b"no sound at all", b"RIFF\x00\x00\x00\x00WAVE"])
def test_what_is_no_sound_is_an_error_as_of_aplay(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "bad.wav"
    path.write_bytes(content)
    player = loudspeaker(tmp_path / "played", str(path), stderr=subprocess.PIPE)
    _, errors = player.communicate(timeout=20)
    assert player.returncode == 1
    assert errors.startswith(b"loudspeaker: ")
    assert playbacks(tmp_path / "played") == []
