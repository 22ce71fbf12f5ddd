"""Copies of recordings: mended, or without some messages."""

from __future__ import annotations

import os
import random
from pathlib import Path

import pytest

from pebble.extensions.recordings.catalogue import look_at
from pebble.extensions.recordings.files.recorded import RecordingError
from pebble.extensions.recordings.files.rewrite import rewrite
from tests.ext.recordings.files.other_readers import Counted, by_mcap
from tests.ext.recordings.files.test_files import zero_a_page
from tests.ext.recordings.messages import contents, write


def test_without_some_messages(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    written = write(path)
    path.chmod(0o640)
    os.utime(path, (1_000_000_000, 1_000_000_000))
    made = rewrite(path, path, keeps=lambda message: "/r3/" not in message.channel.topic)
    rest = [one for one in written if "/r3/" not in one[0]]
    assert contents(path) == rest
    assert (made.messages, made.left_out) == (len(rest), len(written) - len(rest))
    assert (path.stat().st_mode & 0o777, path.stat().st_mtime) == (0o640, 1_000_000_000)
    assert by_mcap(path) == Counted(len(rest), len(rest), len(rest))
    assert not list(tmp_path.glob(".*"))


def test_what_is_missing_stays_known(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write(path, finish=False)
    raw = bytearray(path.read_bytes())
    zero_a_page(raw, random.Random(3))
    path.write_bytes(raw)
    missing = look_at(path).missing
    assert missing > 0
    for number in range(2):
        copy = tmp_path / f"{number}.mcap"
        assert rewrite(path, copy).missing == missing
        assert (look_at(copy).missing, look_at(copy).damaged) == (missing, True)
        path = copy


def test_more_topics_than_a_file_can_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, copy = tmp_path / "a.mcap", tmp_path / "copy.mcap"
    write(path)
    monkeypatch.setattr("pebble.extensions.recordings.files.rewrite.MOST_CHANNELS", 19)
    with pytest.raises(RecordingError, match="one file has no room for more topics"):
        rewrite(path, copy)
    assert not copy.exists()
