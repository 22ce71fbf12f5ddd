"""The index has a row for each message, and the analysis gives what a plain computation over the messages gives."""

from __future__ import annotations

import errno
import os
import re
import shutil
import statistics
from collections import defaultdict
from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import pytest

from pebble.errors import PebbleError
from pebble.extensions.media.packets import Codec, Picture, PictureKind, Sound
from pebble.extensions.recordings.files.recorded import Recorded
from pebble.extensions.recordings.library import merged
from pebble.extensions.recordings.traffic import figures
from pebble.extensions.recordings.traffic.activity import Activity
from pebble.extensions.recordings.traffic.analysis import analyse
from pebble.extensions.recordings.traffic.index import COLUMNS, PICTURE, SOUND, index_path, write_index
from pebble.extensions.recordings.traffic.report import remarks, write_report
from pebble.extensions.recordings.traffic.results import (
    ALL,
    AUDIO,
    COMPONENT,
    HEARTBEATS,
    IDLE,
    SESSION,
    TOTAL,
    VIDEO,
    VOICE,
    Bandwidth,
    Gap,
    RobotTraffic,
    Traffic,
)
from pebble.extensions.recordings.traffic.sources import sources
from pebble.extensions.recordings.traffic.tables import tables, write_csv
from tests.ext.recordings.playing import DRIVE, FRED, GOOB, MEDIA, THEN_NS, Line, js, ms, write
from tests.support import refused

duckdb = pytest.importorskip("duckdb")
pytest.importorskip("matplotlib")

BENJR = "pebble/robots/benjr"
SECOND, MS = 10**9, 10**6


def demo_folder(folder: Path) -> Path:
    """What was recorded of the demo's robots; the file of media is being written."""
    folder.mkdir(parents=True)
    shutil.copy2(DRIVE, folder / "a.state.mcap")
    (folder / "b.media.mcap.active").write_bytes(MEDIA.read_bytes()[:-200])
    return folder


def event(at: float, name: str, **about: Any) -> Line:
    """What the recorder notes about itself."""
    return Line(at, "$recorder/events", js(t=ms(at), event=name, **about))


@pytest.fixture
def of(tmp_path):
    """The traffic of some messages."""

    def analysed(messages: Iterable[Line]) -> Traffic:
        path = write(tmp_path / "recordings" / "x.mcap", messages)
        return analyse(sources([path], tmp_path / "scratch"), tmp_path / "scratch")

    return analysed


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Traffic:
    """The demo's robots."""
    folder = tmp_path_factory.mktemp("demo")
    return analyse(sources([demo_folder(folder / "recordings")], folder / "scratch"), folder / "scratch")


def robot(found: Traffic, base: str = GOOB) -> RobotTraffic:
    return next(one for one in found.robots if one.robot == base)


# -- the same from the messages, without a database


def percentiles(values: Sequence[float]) -> list[float]:
    """The median, and the 95th percentile."""
    return [statistics.quantiles(values, n=100, method="inclusive")[percent - 1] for percent in (50, 95)]


def messages_of(base: str, suffix: str) -> list[Recorded]:
    return [
        message
        for message in merged([DRIVE, MEDIA])
        if message.channel.topic == f"{base}/{suffix}" and "retained" not in message.channel.metadata
    ]


@pytest.mark.parametrize(
    ("base", "family", "suffix"),
    [(FRED, VIDEO, "outgoing/front-camera"), (BENJR, HEARTBEATS, "outgoing/online")],
)
def test_bandwidth_is_that_of_active_seconds(recorded, base, family, suffix):
    messages = messages_of(base, suffix)
    seconds: dict[int, int] = defaultdict(int)
    for message in messages:
        seconds[message.log_ns // SECOND] += len(message.payload)
    one = robot(recorded, base).of(family)
    assert (one.seconds, one.messages) == (len(seconds), len(messages))
    expected = percentiles([size * 8 / 1000 for size in seconds.values()])
    assert [one.median_kbps, one.p95_kbps] == pytest.approx(expected)


@pytest.mark.parametrize("base", [FRED, BENJR])
def test_intervals_outages_and_latency(recorded, base):
    heartbeats = messages_of(base, "outgoing/online")
    times = [message.log_ns for message in heartbeats]
    intervals = [(after - before) / MS for before, after in pairwise(times)]
    usual = statistics.median(intervals)
    outages = [
        (before, interval - usual) for before, interval in zip(times, intervals, strict=False) if interval > 1.5 * usual
    ]
    one = robot(recorded, base)
    assert one.interval_ms == pytest.approx(usual)
    assert [outage.since_ns for outage in one.outages] == [since for since, _ in outages]
    assert [outage.length_ms for outage in one.outages] == pytest.approx([length for _, length in outages])
    latencies = [(message.log_ns - message.publish_ns) / MS for message in heartbeats]
    assert one.latency.count == len(latencies) == sum(one.latency.histogram.counts)
    assert [one.latency.median_ms, one.latency.p95_ms] == pytest.approx(percentiles(latencies))


def test_a_component_without_heartbeats(of):
    found = of([Line(0, "pebble/infrastructure/mast/outgoing/charging-level", b"{}")]).robots[0]
    assert (found.machine, found.interval_ms, found.latency, found.outages) == (COMPONENT, None, None, [])


# -- outages


def heartbeats(base: str, times: Iterable[float]) -> list[Line]:
    """Heartbeats at ``times`` in seconds."""
    return [Line(at, f"{base}/outgoing/online", js(t=ms(at), online=True)) for at in times]


def steady(base: str, *missing: tuple[float, float], seconds: float = 60.0) -> list[Line]:
    times = (number / 4 for number in range(int(seconds * 4)))
    return heartbeats(base, [at for at in times if not any(since < at < until for since, until in missing)])


def ordered(*parts: Iterable[Line]) -> list[Line]:
    return sorted((sent for part in parts for sent in part), key=lambda sent: sent.at)


GAP = event(22, "gap", since=ms(20.1), until=ms(21.9), why="lost")
LATE = [number * 0.25 for number in range(20)] + [4.75 + 0.375 + number * 0.25 for number in range(20)]


@pytest.mark.parametrize(
    ("messages", "lengths_ms"),
    [
        (steady(GOOB, (20.0, 22.0)), [1750.0]),  # beyond the usual interval
        (heartbeats(GOOB, LATE), []),  # of up to one and a half
        (steady(GOOB, (20.0, 80.25), seconds=120.0), []),  # above a minute it was offline
        (ordered(steady(GOOB, (20.0, 22.0), (40.0, 41.0)), [GAP]), [750.0]),  # what was not recorded is none
        (ordered(steady(GOOB, (20.0, 22.0)), [event(21, "start")]), []),
    ],
    ids=["missing", "late", "offline", "not recorded", "the recorder starts"],
)
def test_outages(of, messages, lengths_ms):
    found = of(messages)
    assert [outage.length_ms for outage in robot(found).outages] == lengths_ms
    assert [(gap.until_ns - gap.since_ns, gap.why) for gap in found.gaps] == [(1800 * MS, "lost")] * (GAP in messages)


def test_messages_that_were_dropped_are_counted(of):
    noted = [event(0, "dropped", messages=7, why="the disk is too slow")]
    gap = [event(1, "gap", since=ms(0), until=ms(1), why="full", messages=5)]
    assert of([*noted, *gap, *heartbeats(GOOB, [2.0])]).dropped == 12


def test_the_last_heartbeat_of_a_connection_does_not_count(of):
    will = Line(10.1, f"{GOOB}/outgoing/online", b'{"t": 5, "online": false}')
    assert robot(of(ordered(steady(GOOB), [will]))).latency.count == 240


# -- sessions


def drive(*times: float, moving: bool = True) -> list[Line]:
    payload = b'{"x":0,"z":0.5}' if moving else b'{"x":0,"z":0}'
    return [Line(at, f"{GOOB}/incoming/drive-values", payload) for at in times]


def sessions(found: Traffic) -> list[tuple[int, int]]:
    start = THEN_NS // SECOND
    return [(one.since_s - start, one.until_s - start) for one in robot(found).sessions]


@pytest.mark.parametrize(
    ("messages", "expected"),
    [
        (drive(10.0, 11.0, 30.5), [(5, 36)]),  # with margins
        (drive(10.0, 130.0), [(5, 136)]),  # a break of two minutes belongs to it
        (drive(10.0, 131.0), [(5, 16), (126, 137)]),
        (drive(10.0, moving=False), []),
        ([Line(0, f"{GOOB}/outgoing/logs", b'{"level":"ERROR"}')], []),
    ],
)
def test_sessions(of, messages, expected):
    assert sessions(of(messages)) == expected


def test_bandwidths_of_sessions_and_of_idle_time_are_apart(of):
    goob = robot(of(ordered(steady(GOOB), drive(10.0, 11.0))))
    assert [goob.of(TOTAL, when).messages for when in (SESSION, IDLE)] == [48 + 2, 240 - 48]
    assert sum(goob.of(TOTAL, when).bytes for when in (SESSION, IDLE)) == goob.of(TOTAL, ALL).bytes == goob.bytes


@pytest.mark.parametrize(
    ("metric", "payload", "family"),
    [
        ("incoming/audio-stream", Sound(Codec.OPUS, 1, 48000, 960, 1, ms(0), b"opus").pack(), VOICE),
        ("outgoing/rear-camera", Picture(PictureKind.JPEG, 1, ms(0), b"\xff\xd8").pack(), VIDEO),
        ("incoming/front-camera", b'{"enabled":true}', None),  # a request for pictures
    ],
)
def test_media_are_counted_by_what_they_are(of, metric, payload, family):
    found = robot(of([Line(0, f"{GOOB}/{metric}", payload)]))
    assert [kind for kind in (VIDEO, AUDIO, VOICE) if found.of(kind)] == [kind for kind in (family,) if kind]


# -- periods, places, options


def test_a_file_that_is_being_written_is_read_and_not_indexed(tmp_path):
    folder, scratch = tmp_path / "it's [1] *?", tmp_path / "scratch"  # no pattern
    write(folder / "a.mcap", steady(GOOB, seconds=2.0))
    write(folder / "b.mcap.active", steady(FRED, seconds=3.0), finished=False)
    found = sources([folder], scratch)
    assert (len(found.indexes), found.robots) == (2, [FRED, GOOB])
    assert [path.name for path in folder.glob("*.parquet")] == ["a.parquet"]
    robots = {one.robot: one.messages for one in analyse(found, scratch).robots}
    assert robots == {GOOB: 8, FRED: 12}


def test_a_damaged_index_is_named(tmp_path):
    write(tmp_path / "a.mcap", steady(GOOB, seconds=2.0))
    found = sources([tmp_path], tmp_path / "scratch")
    found.indexes[0].write_bytes(b"no Parquet")
    with pytest.raises(PebbleError) as error:
        analyse(found, tmp_path / "scratch")
    assert "a.parquet" in str(error.value)
    assert "\n" not in str(error.value)


# -- the index: made again when needed, and never seen half made


NAME = "2025/11/20/20251120T010000Z-000001.state.mcap"


def query(sql: str, *parameters: object) -> list[tuple]:
    with duckdb.connect() as connection:
        return connection.execute(sql, parameters).fetchall()


def rows(archive: Path, columns: str, where: str = "true") -> list[tuple]:
    """Read as other programs would: by a pattern."""
    return query(f"SELECT {columns} FROM '{archive}/**/*.parquet' WHERE {where} ORDER BY ts, metric")


def index(archive: Path, messages: list[Line], name: str = NAME) -> None:
    path = write(archive / name, messages)
    write_index(path, index_path(path), archive / "scratch")


def in_turn(*parts: tuple[str, bytes]) -> list[Line]:
    """Messages by topic, a millisecond apart."""
    return [Line(number / 1000, topic, payload) for number, (topic, payload) in enumerate(parts)]


@pytest.mark.parametrize("recording", [DRIVE, MEDIA], ids=["drive", "media"])
def test_each_message_is_a_row(tmp_path, recording):
    index = index_path(tmp_path / "a.mcap")
    write_index(recording, index, tmp_path / "scratch")
    found = rows(tmp_path, "epoch_ns(ts), robot || '/' || direction || '/' || metric, size, retained", "robot != ''")
    expected = [
        (one.log_ns, one.channel.topic, len(one.payload), "retained" in one.channel.metadata)
        for one in merged([recording])
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
    index(tmp_path, in_turn(*((f"{GOOB}/{suffix}", payload) for suffix, payload, _ in USES)))
    assert rows(tmp_path, "activity") == [(activity,) for _, _, activity in USES]
    assert rows(tmp_path, "medium", "medium IS NOT NULL") == [(SOUND,), (PICTURE,)]
    assert rows(tmp_path, "online", "online IS NOT NULL") == [(True,), (True,), (False,)]


def test_a_robot_may_have_any_name_and_what_belongs_to_none_keeps_its_topic(tmp_path):
    robots = [f"pebble/robots/{name}" for name in ("a.b", "x=y", "50% off", "..", "día", "it's", "a\\b")]
    topics = ["pebble/infrastructure", "$SYS/uptime", "a/b/c/sideways/x"]
    index(tmp_path, in_turn(*((f"{robot}/outgoing/status", b"{}") for robot in robots)), "it's.mcap")
    index(tmp_path, in_turn(*((topic, b"{}") for topic in topics)), "none.mcap")
    assert sorted(rows(tmp_path, "robot", "robot != ''")) == [(robot,) for robot in sorted(robots)]
    assert rows(tmp_path, "direction, metric", "robot = ''") == [("", topic) for topic in topics]
    assert sources([tmp_path], tmp_path / "scratch").robots == sorted(robots)


def state(folder: Path) -> list[tuple[Path, int]]:
    return [(path, path.stat().st_mtime_ns) for path in sorted(folder.rglob("*.parquet"))]


HEARTBEATS = in_turn(*((f"{base}/outgoing/online", b"{}") for base in (FRED, GOOB) * 50))


def test_a_recording_is_indexed_once_and_again_when_it_has_changed(tmp_path):
    path = write(tmp_path / NAME, HEARTBEATS)
    assert sources([tmp_path], tmp_path / "scratch").robots == [FRED, GOOB]
    before = state(tmp_path)
    sources([tmp_path], tmp_path / "scratch")
    assert state(tmp_path) == before
    write(path, HEARTBEATS[1::2])
    assert sources([tmp_path], tmp_path / "scratch").robots == [GOOB]


def test_a_failure_leaves_the_former_index_and_nothing_temporary(tmp_path, monkeypatch):
    path = write(tmp_path / NAME, HEARTBEATS)
    sources([tmp_path], tmp_path / "scratch")
    before = state(tmp_path)
    os.utime(path)

    monkeypatch.setattr(Path, "replace", refused(errno.ENOSPC))
    with pytest.raises(OSError):
        sources([tmp_path], tmp_path / "scratch")
    assert state(tmp_path) == before
    assert {one.suffix for one in path.parent.iterdir()} == {".mcap", ".parquet"}


# -- the report: one file that needs no other, in which no name of a robot does anything


EVIL = "<img src=x onerror=alert(1)>"


def test_nothing_is_loaded_or_run_and_every_drawing_has_a_name(recorded, tmp_path):
    page = write_report(recorded, tmp_path)[0].read_text()
    assert re.findall(r"<(?:script|img|link|iframe|object|image)\b", page) == []
    links = re.findall(r'(?:href|src)="([^"]*)"', page)
    assert links
    assert all(link.startswith("#") for link in links)
    assert re.findall(r"https?://|url\((?!#)|@import", page) == []
    assert "default-src 'none'" in page
    drawings = re.findall(r"<svg\b[^>]*>", page)
    assert len(drawings) == 3 * len(recorded.robots)
    assert all('role="img"' in drawing and 'aria-label="' in drawing for drawing in drawings)


@pytest.mark.parametrize(("base", "numbers"), [(FRED, "4.1 4.2 4.3"), (BENJR, "4.4 4.5 4.6 4.3")])
def test_a_figure_has_its_number_in_the_paper(recorded, base, numbers):
    text = " ".join(figure.number for figure in figures.figures(robot(recorded, base)))
    assert re.findall(r"\d\.\d", text) == numbers.split()


def test_marks_of_sessions_and_of_idle_time_have_their_values():
    axes = pytest.importorskip("matplotlib.figure").Figure().add_subplot()
    bandwidths = {SESSION: 500.0, IDLE: 2.0}
    figures.draw_bandwidth(axes, [Bandwidth(VIDEO, when, 1, kbps, kbps, 1, 1) for when, kbps in bandwidths.items()])
    assert {line.get_label(): list(line.get_xdata()) for line in axes.lines} == {"in sessions": [500.0], "idle": [2.0]}


def test_gaps_and_losses_stand_out(recorded):
    gaps = [Gap(THEN_NS, THEN_NS + 10**9, "lost")]
    gap, losses, *_ = remarks(msgspec.structs.replace(recorded, gaps=gaps, dropped=5, missing=7))
    assert gap.startswith("Nothing was recorded once")
    assert "5 messages were not recorded" in losses
    assert "7 were lost to damage" in losses


def test_names_of_robots_do_nothing(of, tmp_path):
    robots = [f"pebble/robots/{name}" for name in (EVIL.replace("/", ""), "$x^2$ & 'y' \"z\"")]
    sent = [Line(at / 10, f"{robots[at % 2]}/outgoing/online", b'{"t":1}') for at in range(60)]
    page = write_report(of(sent), tmp_path)[0].read_text()
    assert EVIL not in page
    assert "&lt;img" in page


@pytest.mark.parametrize("name", ["=1+1", "\tx"])
def test_a_name_is_no_formula(recorded, tmp_path, name):
    table = tables(recorded)[1]
    path = write_csv(type(table)("x", "", [("robot", ""), ("number", "")], [[name, -1]]), tmp_path)
    assert path.read_bytes() == f"robot,number\r\n'{name},-1\r\n".encode()


# -- the command


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TZ", "UTC")
    monkeypatch.chdir(tmp_path)
    return demo_folder(tmp_path / "recordings")


def test_some_robots_some_time_and_csv(run, folder, tmp_path):
    arguments = ["--robot", "fred", "-r", "pebble/robots/benjr", "--since", "2026-11-22T23:46:05", "--until", "+5s"]
    assert run("analyse", folder, *arguments, "--output", tmp_path / "out", "--csv") == 0
    rows = (tmp_path / "out" / "bandwidth.csv").read_text().splitlines()
    assert {row.split(",")[0] for row in rows[1:]} == {"pebble/robots/fred", "pebble/robots/benjr"}
    row = next(row for row in rows if row.startswith("pebble/robots/benjr,MCU,heartbeat,all"))
    since_ns = 1_795_391_165 * 10**9
    heartbeats = messages_of(BENJR, "outgoing/online")
    assert int(row.split(",")[7]) == sum(0 <= message.log_ns - since_ns < 5e9 for message in heartbeats)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["missing.mcap"], "missing.mcap: No such file or directory"),
        (["recordings", "--since", "2030-01-01"], "no message of a robot in this period"),
        (["recordings", "--robot", "a/b"], 'give its id, or "system/type/id"'),
        (["recordings", "--output", "recordings/a.state.mcap"], "recordings/a.state.mcap: File exists"),
    ],
)
def test_what_is_wrong_is_one_line(run, folder, arguments, message):
    assert run("analyse", *arguments) == 1
    assert message in run.err
    assert len(run.err.splitlines()) == 1


def test_packages_that_are_missing_are_named(run, folder, monkeypatch):
    monkeypatch.setattr("pebble.extensions.recordings.traffic.duck.find_spec", lambda _name: None)
    assert run("analyse", folder) == 1
    assert run.err == 'pebble: duckdb and matplotlib missing: pip install "pebble-robot[archive]"\n'
