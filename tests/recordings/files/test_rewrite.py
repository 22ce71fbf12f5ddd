"""Copies of recordings: smaller, mended, or without some messages."""

from __future__ import annotations

import os
import random
from pathlib import Path

import pytest

from pebble.recordings.catalogue import look_at
from pebble.recordings.files.finish import finish
from pebble.recordings.files.mcap import Packer, RecordingError
from pebble.recordings.files.rewrite import rewrite
from pebble.recordings.files.writer import McapWriter
from tests.recordings.files.other_readers import Counted, by_mcap
from tests.recordings.files.test_files import zero_a_page
from tests.recordings.messages import START_NS, contents, write


def test_a_compact_copy_holds_the_same_and_keeps_its_age_and_readers(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    written = write(path, each=5)
    before = path.stat().st_size
    path.chmod(0o640)
    os.utime(path, (1_000_000_000, 1_000_000_000))
    made = rewrite(path, path)
    assert (contents(path), made.messages, made.missing) == (written, len(written), 0)
    assert path.stat().st_size < before * 0.8
    assert (path.stat().st_mode & 0o777, path.stat().st_mtime) == (0o640, 1_000_000_000)
    assert by_mcap(path) == Counted(len(written), len(written), len(written))
    assert not list(tmp_path.glob(".*"))


def test_without_some_messages(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    written = write(path)
    made = rewrite(path, path, keeps=lambda message: "/r3/" not in message.channel.topic)
    assert contents(path) == [one for one in written if "/r3/" not in one[0]]
    assert made.left_out == len(written) - made.messages


def test_what_is_missing_stays_known(tmp_path: Path) -> None:
    path, raw = tmp_path / "a.mcap", bytearray()
    write(path, finish=False)
    raw += path.read_bytes()
    zero_a_page(raw, random.Random(3))
    path.write_bytes(raw)
    missing = finish(path).missing
    assert missing > 0
    assert look_at(path).missing == missing
    for number in range(2):
        copy = tmp_path / f"{number}.mcap"
        assert rewrite(path, copy).missing == missing
        assert look_at(copy).missing == missing
        path = copy


def test_a_damaged_one_is_not_replaced(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write(path)
    raw = bytearray(path.read_bytes())
    zero_a_page(raw, random.Random(1))
    path.write_bytes(raw)
    with pytest.raises(RecordingError, match="damaged"):
        rewrite(path, path)
    assert path.read_bytes() == bytes(raw)
    assert not list(tmp_path.glob(".*"))


def test_invented_topics_of_several_files_have_room(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    topics = [f"pebble/robots/r{number % 9}/outgoing/{number}" for number in range(6000)]
    with path.open("wb", buffering=0) as file:
        writer = McapWriter(file, library="pebble test", packer=Packer(1))
        for number, topic in enumerate(topics):
            writer.add(writer.channel(topic, "json", {}), START_NS + number, b"%d" % number)
        writer.finish()
    rewrite(path, path)
    assert [topic for topic, _ in contents(path)] == topics
    assert [payload for _, payload in contents(path)] == [b"%d" % number for number in range(6000)]
