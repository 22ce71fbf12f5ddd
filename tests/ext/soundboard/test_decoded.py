"""Clips that the service decodes itself, through the raw player."""

from __future__ import annotations

import re

import numpy as np
import pytest

from tests.ext.media.sound_files import encode
from tests.ext.soundboard.soundboard_rig import Soundboard, tone
from tests.support import until


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


@pytest.mark.parametrize(
    ("name", "error"),
    [
        ("bad.mp3", r"Failed to start playback: .*bad\.mp3.*"),
        ("bad.ogg", r"Failed to start playback: bad\.ogg cannot be decoded: .+"),
        ("empty.flac", r"Failed to start playback: there is no sound in empty\.flac"),
    ],
)
def test_what_cannot_be_decoded_is_reported(board: Soundboard, name: str, error: str) -> None:
    (board.sounds / name).write_bytes(b"" if name.startswith("empty") else b"no sound " * 100)
    board.start()
    board.play(name)
    assert until(lambda: board.statuses[-1]["error"], 20)
    assert re.fullmatch(error, board.statuses[-1]["error"])
    assert not board.statuses[-1]["playing"]
    assert board.played == []
