"""The index has a row for each message, is made again when needed, and is never seen half made."""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from pebble.extensions.media.packets import Codec, Sound
from pebble.extensions.recordings.traffic.activity import Activity
from pebble.extensions.recordings.traffic.index import COLUMNS, PICTURE, SOUND, index_path, write_index
from pebble.extensions.recordings.traffic.sources import sources
from tests.ext.recordings.demo_robots import DRIVE, FRED, GOOB, MEDIA, messages
from tests.ext.recordings.playing import write

duckdb = pytest.importorskip("duckdb")

NAME = "2025/11/20/20251120T010000Z-000001.state.mcap"
START_NS = 1_763_600_400 * 10**9  # 2025-11-20 01:00 UTC


class Sent(NamedTuple):
    """One message as a recorder received it."""

    log_ns: int
    topic: str
    payload: bytes
    metadata: dict[str, str] = {"qos": "1", "retain": "0"}  # noqa: RUF012


def write_recording(path: Path, messages: Iterable[Sent], *, finished: bool = True) -> Path:
    """A recording as the recorder writes it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return write(path, messages, finished=finished)


def demo_folder(folder: Path) -> Path:
    """What was recorded of the demo's robots; the file of media is being written."""
    folder.mkdir(parents=True)
    shutil.copy2(DRIVE, folder / "a.state.mcap")
    (folder / "b.media.mcap.active").write_bytes(MEDIA.read_bytes()[:-200])
    return folder


def event(ns: int, name: str, **about: Any) -> Sent:
    """What the recorder notes about itself."""
    return Sent(ns, "$recorder/events", json.dumps({"t": ns // 10**6, "event": name, **about}).encode())


def query(sql: str, *parameters: object) -> list[tuple]:
    with duckdb.connect() as connection:
        return connection.execute(sql, parameters).fetchall()


def rows(archive: Path, columns: str, where: str = "true") -> list[tuple]:
    """Read as other programs would: by a pattern."""
    return query(f"SELECT {columns} FROM '{archive}/**/*.parquet' WHERE {where} ORDER BY ts, metric")


def indexed(archive: Path, messages: list[Sent], name: str = NAME) -> Path:
    """The index of a recording that holds these messages."""
    path = write_recording(archive / name, messages)
    write_index(path, index_path(path), archive / "scratch")
    return index_path(path)


def in_turn(*parts: tuple[str, bytes]) -> list[Sent]:
    """Messages by topic, a millisecond apart."""
    return [Sent(START_NS + number * 10**6, topic, payload) for number, (topic, payload) in enumerate(parts)]


@pytest.mark.parametrize("recording", [DRIVE, MEDIA], ids=["drive", "media"])
def test_each_message_is_a_row(tmp_path, recording):
    index = index_path(tmp_path / "a.mcap")
    write_index(recording, index, tmp_path / "scratch")
    found = rows(tmp_path, "epoch_ns(ts), robot || '/' || direction || '/' || metric, size, retained", "robot != ''")
    expected = [
        (one.log_ns, one.channel.topic, len(one.payload), "retained" in one.channel.metadata)
        for one in messages(recording)
        if not one.channel.topic.startswith("$")
    ]
    assert sorted(found) == sorted(expected)
    described = "SELECT column_name, column_type FROM (DESCRIBE FROM read_parquet(?))"
    assert dict(query(described, str(index))) == COLUMNS


USES = [
    ("incoming/drive-values", b'{"x":0.1,"z":0}', Activity.DRIVE),
    ("incoming/drive-values", b'{"x":0.01,"z":-0.02}', Activity.NONE),
    ("incoming/drive-values", b'{"x":NaN}', Activity.NONE),
    ("incoming/lights-flash", b"{}", Activity.LIGHTS),
    ("incoming/front-camera", b'{"enabled":true}', Activity.MEDIA_REQUEST),
    ("incoming/flags/mqtt-audio", b"true", Activity.MEDIA_REQUEST),
    ("incoming/soundboard-command", b"{}", Activity.SOUND),
    ("incoming/autonomy-command", b"{}", Activity.AUTONOMY),
    ("incoming/audio-stream", Sound(Codec.PCM16LE, 1, 16000, 2, 1, 1, bytes(4)).pack(), Activity.MEDIA),
    ("outgoing/front-camera", b'{"id": 1, "keyframe": true}', Activity.MEDIA),
    ("outgoing/logs", b'{"level": "WARNING", "message": "hot"}', Activity.WARNING),
    ("outgoing/logs", b'{"level": "INFO", "message": "WARNING"}', Activity.NONE),
    ("outgoing/online", b'{"t":1,"online":true}', Activity.NONE),
    ("outgoing/online", b'{"t":1}', Activity.NONE),
    ("outgoing/heartbeat", b'{"t":1, "online": false}', Activity.NONE),
]


def test_the_use_of_a_robot_shows(tmp_path):
    indexed(tmp_path, in_turn(*((f"{GOOB}/{suffix}", payload) for suffix, payload, _ in USES)))
    assert rows(tmp_path, "activity") == [(activity,) for _, _, activity in USES]
    assert rows(tmp_path, "medium", "medium IS NOT NULL") == [(SOUND,), (PICTURE,)]
    assert rows(tmp_path, "online", "online IS NOT NULL") == [(True,), (True,), (False,)]


def test_a_robot_may_have_any_name_and_what_belongs_to_none_keeps_its_topic(tmp_path):
    robots = [f"pebble/robots/{name}" for name in ("a.b", "x=y", "50% off", "..", "día", "it's", "a\\b")]
    topics = ["pebble/infrastructure", "$SYS/uptime", "a/b/c/sideways/x"]
    indexed(tmp_path, in_turn(*((f"{robot}/outgoing/status", b"{}") for robot in robots)), "it's.mcap")
    indexed(tmp_path, in_turn(*((topic, b"{}") for topic in topics)), "none.mcap")
    assert sorted(rows(tmp_path, "robot", "robot != ''")) == [(robot,) for robot in sorted(robots)]
    assert rows(tmp_path, "direction, metric", "robot = ''") == [("", topic) for topic in topics]
    assert sources([tmp_path], tmp_path / "scratch").robots == sorted(robots)


def state(folder: Path) -> list[tuple[Path, int]]:
    return [(path, path.stat().st_mtime_ns) for path in sorted(folder.rglob("*.parquet"))]


HEARTBEATS = in_turn(*((f"{base}/outgoing/online", b"{}") for base in (FRED, GOOB) * 50))


def test_a_recording_is_indexed_once_and_again_when_it_has_changed(tmp_path):
    path = write_recording(tmp_path / NAME, HEARTBEATS)
    assert sources([tmp_path], tmp_path / "scratch").robots == [FRED, GOOB]
    before = state(tmp_path)
    sources([tmp_path], tmp_path / "scratch")
    assert state(tmp_path) == before
    write_recording(path, HEARTBEATS[1::2])
    assert sources([tmp_path], tmp_path / "scratch").robots == [GOOB]


def test_a_failure_leaves_the_former_index_and_nothing_temporary(tmp_path, monkeypatch):
    path = write_recording(tmp_path / NAME, HEARTBEATS)
    sources([tmp_path], tmp_path / "scratch")
    before = state(tmp_path)
    os.utime(path)

    def fails(*_: object) -> Path:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "replace", fails)
    with pytest.raises(OSError):
        sources([tmp_path], tmp_path / "scratch")
    assert state(tmp_path) == before
    assert {one.suffix for one in path.parent.iterdir()} == {".mcap", ".parquet"}
