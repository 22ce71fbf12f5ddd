"""The index has a row for each message, is made again when needed, and is never seen half made."""

import json
import os
import shutil
import time
from pathlib import Path

import pytest

from pebble.contract.packets import Codec, Sound
from pebble.recordings.files.recorded import RecordingError
from pebble.recordings.traffic.activity import Activity
from pebble.recordings.traffic.index import COLUMNS, NO_ROBOT, Index, archive_of, not_indexed
from tests.recordings.synthetic import FLEET, START_NS, Sent, event, traffic, write_recording

duckdb = pytest.importorskip("duckdb")

GOOB = FLEET[0].base
SECOND = 10**9
DAY_NS = 86_400 * SECOND


def query(sql: str, *parameters: object) -> list[tuple]:
    with duckdb.connect() as connection:
        return connection.execute(sql, parameters).fetchall()


def rows(archive: Path, columns: str, where: str = "true") -> list[tuple]:
    """Read as other programs would: by a pattern, with the day and the robot from the folders' names."""
    return query(f"SELECT {columns} FROM '{archive}/index/day=*/robot=*/*.parquet' WHERE {where} ORDER BY ts")


def one_message(suffix: str, payload: bytes, **more: object) -> list[Sent]:
    return [Sent(START_NS, f"{GOOB}/{suffix}", payload, **more)]


def recording(archive: Path, messages: list[Sent], name: str = "2025/11/20/20251120T010000Z-000001.state.mcap") -> Path:
    return write_recording(archive / name, messages)


def test_each_message_is_a_row(tmp_path):
    messages = traffic()
    entry = Index(tmp_path).add(recording(tmp_path, messages))
    assert entry.rows == len(messages) == rows(tmp_path, "count(*), any_value(ts) AS ts")[0][0]
    found = rows(tmp_path, "epoch_ns(ts), robot || '/' || direction || '/' || metric, size, retained")
    expected = [(sent.ns, sent.topic, len(sent.payload), sent.retained) for sent in messages]
    assert sorted(found) == sorted(expected)


def test_the_columns_have_the_promised_types(tmp_path):
    entry = Index(tmp_path).add(recording(tmp_path, traffic(seconds=2.0)))
    path = tmp_path / "index" / entry.parts[0].path
    described = query(
        "SELECT column_name, column_type FROM (DESCRIBE FROM read_parquet(?, hive_partitioning = false))", str(path)
    )
    assert dict(described) == COLUMNS


def test_times_keep_their_nanoseconds_and_days_are_those_of_utc(tmp_path):
    late = START_NS // DAY_NS * DAY_NS + DAY_NS
    recording(
        tmp_path, [Sent(late - 1, f"{GOOB}/outgoing/status", b"{}"), Sent(late, f"{GOOB}/outgoing/status", b"{}")]
    )
    Index(tmp_path).add(next(tmp_path.rglob("*.mcap")))
    found = rows(tmp_path, "epoch_ns(ts), day::VARCHAR, robot")
    assert found == [(late - 1, "2025-11-20", GOOB), (late, "2025-11-21", GOOB)]


def test_media_have_their_numbers(tmp_path):
    packet = Sound(Codec.PCM16LE, 1, 16000, 320, 4_294_967_295, 1_763_600_400_123, bytes(640)).pack()
    Index(tmp_path).add(recording(tmp_path, one_message("outgoing/audio", packet)))
    found = rows(tmp_path, "number, keyframe, kind, activity, size, epoch_ms(stamp)")
    assert found == [(4_294_967_295, None, 21, Activity.MEDIA, 664, 1_763_600_400_123)]


USES = [
    ("incoming/drive-values", b'{"x":0.1,"z":0}', Activity.DRIVE),
    ("incoming/drive-values", b'{"value":{"x":0,"z":-0.5}}', Activity.DRIVE),
    ("incoming/drive-values", b'{"x":0.01,"z":-0.02}', Activity.NONE),
    ("incoming/drive-values", b'{"x":NaN}', Activity.NONE),
    ("incoming/drive-values", b"\xff not JSON", Activity.NONE),
    ("incoming/lights-flash", b"{}", Activity.LIGHTS),
    ("incoming/front-camera", b'{"enabled":true}', Activity.MEDIA_REQUEST),
    ("incoming/flags/mqtt-audio", b"true", Activity.MEDIA_REQUEST),
    ("incoming/soundboard-command", b"{}", Activity.SOUND),
    ("incoming/autonomy-command", b"{}", Activity.AUTONOMY),
    ("incoming/audio-stream", Sound(Codec.PCM16LE, 1, 16000, 2, 1, 1, bytes(4)).pack(), Activity.MEDIA),
    ("outgoing/logs", b'{"level": "WARNING", "message": "hot"}', Activity.WARNING),
    ("outgoing/logs", b'{"level": "INFO", "message": "WARNING"}', Activity.NONE),
    ("outgoing/status", b"{}", Activity.NONE),
]


def in_turn(*parts: tuple[str, bytes]) -> list[Sent]:
    """Messages by topic, a millisecond apart."""
    return [Sent(START_NS + number * 10**6, topic, payload) for number, (topic, payload) in enumerate(parts)]


def test_the_use_of_a_robot_shows(tmp_path):
    Index(tmp_path).add(recording(tmp_path, in_turn(*((f"{GOOB}/{suffix}", payload) for suffix, payload, _ in USES))))
    assert rows(tmp_path, "activity") == [(activity,) for _, _, activity in USES]


def test_a_heartbeat_may_be_the_last(tmp_path):
    heartbeats = [
        ("outgoing/online", b'{"t":1,"online":true}', True),
        ("outgoing/online", b'{"t":1}', True),
        ("outgoing/heartbeat", b'{"t":1, "online": false}', False),
        ("outgoing/status", b'{"online": false}', None),
    ]
    messages = in_turn(*((f"{GOOB}/{suffix}", payload) for suffix, payload, _ in heartbeats))
    Index(tmp_path).add(recording(tmp_path, messages))
    assert rows(tmp_path, "online") == [(online,) for _, _, online in heartbeats]


def test_what_belongs_to_no_robot_keeps_its_topic(tmp_path):
    topics = ["pebble/infrastructure", "$SYS/uptime", "a/b/c/sideways/x", f"a/{'ä' * 60}/c/outgoing/x"]
    Index(tmp_path).add(recording(tmp_path, in_turn(*((topic, b"{}") for topic in topics))))
    assert rows(tmp_path, "robot, direction, metric") == [(NO_ROBOT, "", topic) for topic in topics]


def test_any_name_of_a_robot_is_a_folder(tmp_path):
    robots = [f"pebble/robots/{name}" for name in ("a.b", "x=y", "50% off", "..", "día", "it's", "a\\b")]
    Index(tmp_path).add(recording(tmp_path, in_turn(*((f"{robot}/outgoing/status", b"{}") for robot in robots))))
    assert rows(tmp_path, "robot") == [(robot,) for robot in robots]


def test_events_of_the_recorder_are_beside_it(tmp_path):
    since, until = START_NS // 10**6 - 5000, START_NS // 10**6
    broken = Sent(START_NS, "$recorder/events", b"no JSON")
    recording(tmp_path, [event(START_NS, "gap", since=since, until=until, why="lost"), broken])
    entry = Index(tmp_path).add(next(tmp_path.rglob("*.mcap")))
    found = query(
        f"SELECT event, epoch_ms(since), epoch_ms(until), json->>'why' FROM '{tmp_path}/index/{entry.events[0]}'"
    )
    assert found == [("gap", since, until, "lost")]


def test_times_beyond_what_a_timestamp_holds_are_left_out(tmp_path):
    path = recording(
        tmp_path, [Sent(START_NS, f"{GOOB}/outgoing/status", b"{}"), Sent(1 << 63, f"{GOOB}/outgoing/status", b"")]
    )
    assert Index(tmp_path).add(path).rows == 1


def test_a_recording_is_indexed_once(tmp_path):
    path = recording(tmp_path, traffic(seconds=2.0))
    assert not_indexed(tmp_path) == [path]
    index = Index(tmp_path)
    entry = index.add(path)
    assert not_indexed(tmp_path) == []
    made = {part: (index.folder / part.path).stat().st_mtime_ns for part in entry.parts}
    assert index.add(path) == entry
    assert {part: (index.folder / part.path).stat().st_mtime_ns for part in entry.parts} == made


def test_a_recording_that_has_changed_is_indexed_again(tmp_path):
    messages = traffic(seconds=3.0)
    path = recording(tmp_path, messages)
    index = Index(tmp_path)
    index.add(path)
    recording(tmp_path, [sent for sent in messages if sent.topic.startswith(GOOB)])
    assert not_indexed(tmp_path) == [path]
    entry = index.add(path)
    assert {part.robot for part in entry.parts} == {GOOB}
    assert rows(tmp_path, "DISTINCT robot, NULL AS ts") == [(GOOB, None)]  # files of the others are deleted


@pytest.mark.parametrize("lost", ["*.json", "*.parquet"])
def test_an_index_with_a_part_missing_is_made_again(tmp_path, lost):
    path = recording(tmp_path, traffic(seconds=2.0))
    index = Index(tmp_path)
    entry = index.add(path)
    next(index.folder.rglob(lost)).unlink()
    assert not_indexed(tmp_path) == [path]
    assert index.add(path) == entry


def test_an_entry_that_cannot_be_read_does_not_count(tmp_path):
    path = recording(tmp_path, traffic(seconds=2.0))
    index = Index(tmp_path)
    index.add(path)
    next(index.folder.rglob("*.json")).write_text("half a f")
    assert list(index.entries()) == []
    assert not_indexed(tmp_path) == [path]


def test_the_index_outlives_the_recording_until_it_is_removed(tmp_path):
    path = recording(tmp_path, traffic(seconds=2.0))
    index = Index(tmp_path)
    entry = index.add(path)
    path.unlink()
    assert list(index.entries()) == [entry]
    index.remove(path)
    assert list(index.entries()) == []
    assert list(index.folder.rglob("*.parquet")) == []


def test_nothing_temporary_is_left(tmp_path):
    index = Index(tmp_path)
    index.add(recording(tmp_path, traffic(seconds=2.0)))
    assert [path.name for path in index.folder.iterdir() if path.name.startswith(".")] == []


def test_what_a_killed_process_left_is_deleted_after_a_day(tmp_path):
    index = Index(tmp_path)
    for name, age_s in (("old", 100_000), ("new", 10)):
        (index.folder / f".making-{name}").mkdir(parents=True)
        os.utime(index.folder / f".making-{name}", (time.time() - age_s,) * 2)
    index.add(recording(tmp_path, traffic(seconds=1.0)))
    assert [path.name for path in index.folder.glob(".making-*")] == [".making-new"]


def test_a_failure_leaves_the_former_index(tmp_path, monkeypatch):
    path = recording(tmp_path, traffic(seconds=2.0))
    index = Index(tmp_path)
    index.add(path)
    before = rows(tmp_path, "count(*), NULL AS ts")
    os.utime(path)
    monkeypatch.setattr(
        "pebble.recordings.traffic.index._move", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left"))
    )
    with pytest.raises(OSError):
        index.add(path)
    assert rows(tmp_path, "count(*), NULL AS ts") == before
    assert not_indexed(tmp_path) == [path]


def test_a_torn_recording_is_indexed_as_far_as_it_goes(tmp_path):
    messages = traffic(seconds=5.0)
    path = write_recording(tmp_path / "x.mcap.active", messages, finished=False)
    whole = path.read_bytes()
    path.write_bytes(whole + whole[-1000:-500])
    assert Index(tmp_path, tmp_path / "elsewhere").add(path).rows == len(messages)
    assert not_indexed(tmp_path) == []  # what is still being written does not count
    assert not (tmp_path / "index").exists()


def test_two_recordings_of_one_name_are_two(tmp_path):
    index = Index(tmp_path)
    for folder in ("one", "two"):
        index.add(recording(tmp_path, traffic(seconds=1.0), f"{folder}/x.mcap"))
    assert len(list(index.entries())) == 2
    assert rows(tmp_path, "DISTINCT file, NULL AS ts", "robot LIKE '%goob'")


def test_a_very_long_name_is_shortened(tmp_path):
    path = recording(tmp_path, traffic(seconds=1.0), f"{'long ' * 20}/{'name ' * 40}.mcap")
    entry = Index(tmp_path).add(path)
    assert Index(tmp_path).entry(path) == entry


def test_an_archive_may_be_moved(tmp_path):
    path = recording(tmp_path / "old", traffic(seconds=1.0))
    Index(tmp_path / "old").add(path)
    shutil.move(tmp_path / "old", tmp_path / "new")
    assert not_indexed(tmp_path / "new") == []


def test_archive_of():
    assert (
        archive_of(Path("/a/b/2026/11/20")) == archive_of(Path("/a/b/2026")) == archive_of(Path("/a/b")) == Path("/a/b")
    )


def test_a_file_that_is_no_recording_is_refused(tmp_path):
    with pytest.raises((RecordingError, OSError)):
        Index(tmp_path).add(tmp_path / "missing.mcap")


def test_progress_ends_at_one(tmp_path):
    shares: list[float] = []
    Index(tmp_path).add(recording(tmp_path, traffic(seconds=1.0)), shares.append)
    assert shares[-1] == 1.0


def test_the_entry_can_be_read_by_others(tmp_path):
    path = recording(tmp_path, traffic(seconds=1.0))
    Index(tmp_path).add(path)
    entry = json.loads(next((tmp_path / "index" / "recordings").iterdir()).read_text())
    assert tmp_path / entry["recording"] == path
