"""Clips that the service decodes itself, through the raw player."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from tests.media.sound_files import encode
from tests.services.soundboard_handler.conftest import Make
from tests.services.soundboard_handler.soundboard_rig import LONG, Soundboard, tone, write_wav
from tests.support import until


@pytest.fixture
def quiet(make: Make) -> Soundboard:
    """It plays at a quarter of the volume."""
    return make(volume=0.25)


def test_other_formats_are_decoded_and_played(board: Soundboard) -> None:
    sound = tone(0.5, 2, 48_000)
    for ending in ("mp3", "ogg", "flac"):
        encode(board.sounds / f"tone.{ending}", sound, 48_000)
    board.start()
    assert board.files == ["tone.flac", "tone.mp3", "tone.ogg"]
    for name in board.files:
        assert board.plays(name)
    assert [(one.file, one.rate, one.channels) for one in board.played] == [("-", 48_000, 2)] * 3
    assert np.array_equal(board.samples(0), sound), "flac loses nothing"
    for number in (1, 2):
        played = board.samples(number).astype(float)
        assert len(played) == pytest.approx(len(sound), abs=4000)
        loudness = np.sqrt(np.mean(np.square(played), axis=0))
        assert loudness == pytest.approx([9000 / 2**0.5] * 2, rel=0.1)


def test_the_volume_of_a_wav_file(quiet: Soundboard) -> None:
    write_wav(quiet.sounds / "a.wav", tone(0.3))
    quiet.start()
    assert quiet.plays("a.wav")
    assert quiet.played[0].file == "-"
    assert np.array_equal(quiet.samples(), np.rint(0.25 * tone(0.3)).astype(np.int16))


def test_a_decoded_clip_is_stopped_replaced_and_repeated(quiet: Soundboard) -> None:
    write_wav(quiet.sounds / "long.wav", tone(60))
    write_wav(quiet.sounds / "short.wav", tone(0.1))
    quiet.start()
    quiet.play("long.wav")
    assert until(lambda: len(quiet.played) == 1)
    assert quiet.plays("short.wav", repeat=2)
    assert [one.stopped for one in quiet.played] == [True, False, False]
    quiet.play("long.wav")
    quiet.send(False)
    assert quiet.became(playing=False, file=None, error=None)
    assert until(lambda: quiet.players() == [])


@pytest.mark.parametrize(
    ("name", "error"),
    [
        ("bad.wav", r"Failed to start playback: bad\.wav cannot be decoded: .+"),
        ("bad.mp3", r"Failed to start playback: .*bad\.mp3.*"),
        ("bad.ogg", r"Failed to start playback: bad\.ogg cannot be decoded: .+"),
        ("empty.flac", r"Failed to start playback: there is no sound in empty\.flac"),
    ],
)
def test_what_cannot_be_decoded_is_reported(quiet: Soundboard, name: str, error: str) -> None:
    (quiet.sounds / name).write_bytes(b"" if name.startswith("empty") else b"no sound " * 100)
    quiet.start()
    quiet.play(name)
    assert until(lambda: quiet.statuses[-1]["error"], 20)
    assert re.fullmatch(error, quiet.statuses[-1]["error"])
    assert not quiet.statuses[-1]["playing"]
    assert quiet.played == []


def test_an_hour_of_sound_takes_little_memory(make: Make) -> None:
    """The player reads only a little."""
    board = make(volume=0.5, player_command=LONG)
    path = write_wav(board.sounds / "hour.wav", tone(0.1, 2))
    with path.open("r+b") as file:
        size = 3600 * 16_000 * 4
        file.seek(40)
        file.write(size.to_bytes(4, "little"))
        file.truncate(44 + size)
    board.start()
    board.play("hour.wav")
    assert board.became(playing=True, file="hour.wav", error=None)
    assert until(lambda: board.played and board.played[0].frames())
    peak_kb = int(re.search(r"VmHWM:\s+(\d+)", Path(f"/proc/{board.process.pid}/status").read_text())[1])
    assert peak_kb < path.stat().st_size / 1024 / 2
