"""Pictures and sound into files, where there is no screen."""

from __future__ import annotations

import wave
from itertools import count
from pathlib import Path

import cv2
import numpy as np
import pytest

from pebble.client.media_receiver import MediaReceiver
from pebble.client.overlays import STALE_S, Label, Overlays
from pebble.commands.terminal.screens import Files, save_picture, with_overlays
from pebble.errors import PebbleError
from pebble.media.decode import Decoded
from pebble.media.sound import ReceivedSound
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.client.estop_robot import outgoing


@pytest.fixture
def receiver() -> MediaReceiver:
    return MediaReceiver(MemoryTransport("viewer", MemoryHub()).open(), "pebble/robots/goob")


def received(rate: int, sequence: int = 1) -> ReceivedSound:
    return ReceivedSound(np.full((rate // 50, 1), 1000, np.int16), rate, 1, 0, sequence, "pcm")


def test_pictures_and_sound_become_files(
    receiver: MediaReceiver, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    picture = np.zeros((48, 64, 3), np.uint8)
    picture[:, :, 2] = 200
    receiver.newest = Decoded(picture, 0, 1, True, "json")
    monkeypatch.setattr(receiver, "take_sounds", lambda: [received(16_000), received(16_000), received(8_000)])
    files = Files(tmp_path / "new" / "folder")
    files.show(receiver)
    files.close()
    assert cv2.imread(str(tmp_path / "new" / "folder" / "0001.png")).tolist() == picture.tolist()
    with wave.open(str(tmp_path / "new" / "folder" / "sound.wav")) as first:
        assert (first.getframerate(), first.getnframes()) == (16_000, 640)
    with wave.open(str(tmp_path / "new" / "folder" / "sound-2.wav")) as second:
        assert (second.getframerate(), second.getnframes()) == (8_000, 160)
    assert files.summary().endswith("folder: 1 pictures, 0.1 s of sound")


def test_a_stopped_robot_is_shown(receiver: MediaReceiver, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = Files(tmp_path, count(0.0, 2.0).__next__)
    files.show(receiver)
    assert "STOP" not in capsys.readouterr().out
    state = {"latched": True, "boot": "0", "count": 1, "recent": [], "by": "ann", "why": "dog", "since": 1}
    receiver.estop.receive(outgoing("pebble/robots/goob", "estop/serial", state))
    files.show(receiver)
    assert "EMERGENCY STOP: goob is stopped by ann, " in capsys.readouterr().out


def test_overlays_are_drawn_over_the_picture_while_they_are_fresh(receiver: MediaReceiver, tmp_path: Path) -> None:
    receiver.newest = Decoded(np.zeros((48, 64, 3), np.uint8), 0, 1, True, "json")
    files = Files(tmp_path, iter((10.0, 20.0)).__next__)
    for at in (10.0, 19.0 - STALE_S):
        receiver.overlays.receive(b'{"shapes": [[[0, 0], [1, 0], [1, 1], [0, 1]]]}', at)
        files.show(receiver)
    fresh, stale = (cv2.imread(str(tmp_path / name)) for name in ("0001.png", "0002.png"))
    assert fresh[0].any(axis=1).all()  # the upper edge
    assert fresh[-1].any(axis=1).all()  # the lower edge
    assert not stale.any()


def test_shapes_are_where_their_points_are_and_labels_around_theirs() -> None:
    picture = np.full((480, 640, 3), 127, np.uint8)
    shape = ((0.25, 0.25), (0.75, 0.25), (0.75, 0.75), (0.25, 0.75))
    drawn = with_overlays(picture, Overlays((shape,), (Label("13", (0.5, 0.5)),)))
    assert (picture == 127).all()  # other readers have it, too
    rows, columns = np.nonzero((drawn != 127).any(axis=2))
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == pytest.approx((120, 359, 160, 479), abs=3)
    inner = (drawn != 127).any(axis=2)[140:340, 180:460]
    rows, columns = np.nonzero(inner)
    assert (rows.mean() + 140, columns.mean() + 180) == pytest.approx((239.5, 319.5), abs=3)


@pytest.mark.parametrize("name", ["picture.xyz", "no/such/folder/picture.png"])
def test_a_picture_that_cannot_be_written_is_one_line(tmp_path: Path, name: str) -> None:
    with pytest.raises(PebbleError, match=name):
        save_picture(np.zeros((4, 4, 3), np.uint8), tmp_path / name)


def test_a_folder_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(PebbleError, match="cannot be made"):
        Files(tmp_path / "file" / "folder")
