"""The analysis gives what a plain computation over the messages gives."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path

import pytest

from pebble.contract.packets import Codec, Picture, PictureKind, Sound
from pebble.errors import PebbleError
from pebble.extensions.recordings.files.recorded import Recorded
from pebble.extensions.recordings.library import merged
from pebble.extensions.recordings.traffic.analysis import analyse
from pebble.extensions.recordings.traffic.results import (
    ALL,
    AUDIO,
    COMPONENT,
    HEARTBEATS,
    IDLE,
    LINUX,
    MCU,
    SESSION,
    TOTAL,
    VIDEO,
    VOICE,
    RobotTraffic,
    Traffic,
)
from pebble.extensions.recordings.traffic.sources import sources
from tests.ext.recordings.synthetic import FLEET, START_NS, Sent, event, traffic, write_recording

pytest.importorskip("duckdb")

SECOND, MS = 10**9, 10**6
GOOB, FRED, MINILAMP, BENJR = (robot.base for robot in FLEET)


def analysed(folder: Path, messages: Iterable[Sent], scratch: Path, **options: object) -> Traffic:
    write_recording(folder / "x.mcap", messages)
    return analyse(sources([folder], scratch), scratch, **options)


@pytest.fixture
def of(tmp_path):
    """The traffic of some messages."""
    return lambda messages, **options: analysed(tmp_path / "recordings", messages, tmp_path / "scratch", **options)


@pytest.fixture(scope="module")
def minute(tmp_path_factory) -> tuple[Path, Traffic]:
    folder = tmp_path_factory.mktemp("minute")
    return folder / "recordings" / "x.mcap", analysed(folder / "recordings", traffic(), folder / "scratch")


def robot(found: Traffic, base: str) -> RobotTraffic:
    return next(one for one in found.robots if one.robot == base)


# -- the same from the messages, without a database


def percentile(values: Sequence[float], share: float) -> float:
    ordered = sorted(values)
    place = share * (len(ordered) - 1)
    low = math.floor(place)
    high = min(low + 1, len(ordered) - 1)
    return ordered[low] + (ordered[high] - ordered[low]) * (place - low)


def messages_of(path: Path, base: str, suffix: str) -> list[Recorded]:
    return [
        message
        for message in merged([path])
        if message.channel.topic == f"{base}/{suffix}" and "retained" not in message.channel.metadata
    ]


def kbps_by_second(messages: Iterable[Recorded]) -> list[float]:
    seconds: dict[int, int] = defaultdict(int)
    for message in messages:
        seconds[message.log_ns // SECOND] += len(message.payload)
    return [size * 8 / 1000 for size in seconds.values()]


@pytest.mark.parametrize("base", [GOOB, FRED])
@pytest.mark.parametrize(
    ("family", "suffix"), [(VIDEO, "outgoing/front-camera"), (AUDIO, "outgoing/audio"), (HEARTBEATS, "outgoing/online")]
)
def test_bandwidth_is_that_of_active_seconds(minute, base, family, suffix):
    path, found = minute
    expected = kbps_by_second(messages_of(path, base, suffix))
    one = robot(found, base).of(family)
    assert one.seconds == len(expected)
    assert one.median_kbps == pytest.approx(percentile(expected, 0.5))
    assert one.p95_kbps == pytest.approx(percentile(expected, 0.95))
    assert one.messages == len(messages_of(path, base, suffix))


def test_one_channel_of_pcm_takes_what_the_paper_measured(minute):
    assert robot(minute[1], FRED).of(AUDIO).median_kbps == 265.6


def test_stereo_takes_what_the_paper_measured(of):
    packet = Sound(Codec.PCM16LE, 2, 16000, 320, 1, START_NS // MS, bytes(1280)).pack()
    found = of(Sent(START_NS + number * 20 * MS, f"{GOOB}/outgoing/audio", packet) for number in range(500))
    assert robot(found, GOOB).of(AUDIO).median_kbps == 521.6


@pytest.mark.parametrize("base", [one.base for one in FLEET])
def test_intervals_and_outages(minute, base):
    path, found = minute
    times = [message.log_ns for message in messages_of(path, base, "outgoing/online")]
    intervals = [(after - before) / MS for before, after in pairwise(times)]
    usual = percentile(intervals, 0.5)
    outages = [
        (before, interval - usual) for before, interval in zip(times, intervals, strict=False) if interval > 1.5 * usual
    ]
    one = robot(found, base)
    assert one.interval_ms == pytest.approx(usual)
    assert [outage.since_ns for outage in one.outages] == [since for since, _ in outages]
    assert [outage.length_ms for outage in one.outages] == pytest.approx([length for _, length in outages])


@pytest.mark.parametrize("base", [one.base for one in FLEET])
def test_latency(minute, base):
    path, found = minute
    latencies = [(message.log_ns - message.publish_ns) / MS for message in messages_of(path, base, "outgoing/online")]
    one = robot(found, base).latency
    assert one.count == len(latencies) == sum(one.histogram.counts)
    assert [one.median_ms, one.p95_ms] == pytest.approx([percentile(latencies, share) for share in (0.5, 0.95)])


# -- what robots are like


def test_kinds_of_robots(minute):
    kinds = {one.robot: one.machine for one in minute[1].robots}
    assert kinds == {GOOB: LINUX, FRED: LINUX, MINILAMP: MCU, BENJR: MCU}


def test_a_component_without_heartbeats(of):
    found = of([Sent(START_NS, "pebble/infrastructure/mast/outgoing/charging-level", b"{}")]).robots[0]
    assert (found.machine, found.interval_ms, found.latency, found.outages) == (COMPONENT, None, None, [])


def test_stamps_of_clocks_that_were_never_set_do_not_count(of):
    found = of([Sent(START_NS, f"{GOOB}/outgoing/online", b'{"t": 5000}')])
    assert robot(found, GOOB).latency is None


# -- outages


def heartbeats(base: str, times: Iterable[float]) -> list[Sent]:
    """Heartbeats at ``times`` in seconds."""
    t = START_NS // MS
    return [
        Sent(
            START_NS + round(at * SECOND),
            f"{base}/outgoing/online",
            b'{"t": %d, "online": true}' % (t + round(at * 1000)),
        )
        for at in times
    ]


def steady(base: str, *missing: tuple[float, float], seconds: float = 60.0, rate_hz: float = 4.0) -> list[Sent]:
    times = (number / rate_hz for number in range(int(seconds * rate_hz)))
    return heartbeats(base, [at for at in times if not any(since < at < until for since, until in missing)])


def ordered(*parts: Iterable[Sent]) -> list[Sent]:
    return sorted((sent for part in parts for sent in part), key=lambda sent: sent.ns)


def test_the_length_of_an_outage_is_beyond_the_usual(of):
    found = robot(of(steady(GOOB, (20.0, 22.0))), GOOB)
    assert [outage.length_ms for outage in found.outages] == [1750.0]
    assert found.outages[0].since_ns == START_NS + 20 * SECOND


def test_an_interval_of_up_to_one_and_a_half_is_none(of):
    times = [number * 0.25 for number in range(20)] + [4.75 + 0.375 + number * 0.25 for number in range(20)]
    assert robot(of(heartbeats(GOOB, times)), GOOB).outages == []


def test_above_a_minute_a_robot_was_offline(of):
    found = robot(of(steady(GOOB, (20.0, 90.0), seconds=120.0)), GOOB)
    assert found.outages == []


def test_what_was_not_recorded_is_no_outage(of):
    gap = event(START_NS + 22 * SECOND, "gap", since=START_NS // MS + 20_100, until=START_NS // MS + 21_900, why="lost")
    found = of(ordered(steady(GOOB, (20.0, 22.0), (40.0, 41.0)), [gap]))
    assert [outage.length_ms for outage in robot(found, GOOB).outages] == [750.0]
    assert [(one.until_ns - one.since_ns, one.why) for one in found.gaps] == [(1800 * MS, "lost")]


@pytest.mark.parametrize("name", ["start", "clock"])
def test_nothing_is_measured_across_a_start_of_the_recorder(of, name):
    noted = event(START_NS + 21 * SECOND, name)
    assert robot(of(ordered(steady(GOOB, (20.0, 22.0)), [noted])), GOOB).outages == []


def test_messages_that_were_dropped_are_counted(of):
    noted = [event(START_NS, "dropped", messages=7, why="the disk is too slow")]
    gap = [event(START_NS + SECOND, "gap", since=START_NS // MS, until=START_NS // MS + 1000, why="full", messages=5)]
    assert of([*noted, *gap, *heartbeats(GOOB, [2.0])]).dropped == 12


def test_the_last_heartbeat_of_a_connection_does_not_count(of):
    will = Sent(START_NS + 10 * SECOND + 100 * MS, f"{GOOB}/outgoing/online", b'{"t": 5, "online": false}')
    assert robot(of(ordered(steady(GOOB), [will])), GOOB).latency.count == 240


def test_both_names_of_the_heartbeat_count_once(of):
    both = [Sent(sent.ns + MS, sent.topic.replace("online", "heartbeat"), sent.payload) for sent in steady(GOOB)]
    assert robot(of(ordered(steady(GOOB), both)), GOOB).interval_ms == 250.0


# -- sessions


def drive(*times: float, moving: bool = True) -> list[Sent]:
    payload = b'{"x":0,"z":0.5}' if moving else b'{"x":0,"z":0}'
    return [Sent(START_NS + round(at * SECOND), f"{GOOB}/incoming/drive-values", payload) for at in times]


def sessions(found: Traffic) -> list[tuple[int, int]]:
    start = START_NS // SECOND
    return [(one.since_s - start, one.until_s - start) for one in robot(found, GOOB).sessions]


@pytest.mark.parametrize(
    ("messages", "expected"),
    [
        (drive(10.0, 11.0, 30.5), [(5, 36)]),  # with margins
        (drive(10.0, 130.0), [(5, 136)]),  # a break of two minutes belongs to it
        (drive(10.0, 131.0), [(5, 16), (126, 137)]),
        (drive(10.0, moving=False), []),
        ([Sent(START_NS, f"{GOOB}/outgoing/logs", b'{"level":"ERROR"}')], []),
    ],
)
def test_sessions(of, messages, expected):
    assert sessions(of(messages)) == expected


def test_bandwidths_of_sessions_and_of_idle_time_are_apart(minute):
    goob = robot(minute[1], GOOB)
    assert [session.until_s - session.since_s for session in goob.sessions] == [41]
    assert goob.of(VIDEO, IDLE) is None
    assert goob.of(TOTAL, IDLE).median_kbps < 3 < 300 < goob.of(TOTAL, SESSION).median_kbps
    both = goob.of(TOTAL, SESSION), goob.of(TOTAL, IDLE)
    assert sum(one.bytes for one in both) == goob.of(TOTAL, ALL).bytes == goob.bytes


def test_sound_sent_to_a_robot_is_not_its_audio(of):
    packet = Sound(Codec.OPUS, 1, 48000, 960, 1, START_NS // MS, b"opus").pack()
    found = robot(of([Sent(START_NS, f"{GOOB}/incoming/audio-stream", packet)]), GOOB)
    assert found.of(VOICE).messages == 1
    assert found.of(AUDIO) is None


def test_a_request_for_pictures_is_no_video(of):
    found = robot(of([Sent(START_NS, f"{GOOB}/incoming/front-camera", b'{"enabled":true}')]), GOOB)
    assert found.of(VIDEO) is None


def test_video_under_another_topic_is_video(of):
    picture = Picture(PictureKind.JPEG, 1, START_NS // MS, b"\xff\xd8").pack()
    found = robot(of([Sent(START_NS, f"{GOOB}/outgoing/rear-camera", picture)]), GOOB)
    assert found.of(VIDEO).messages == 1


def test_retained_messages_are_not_traffic(minute):
    path, found = minute
    total = sum("retained" not in message.channel.metadata for message in merged([path]))
    assert sum(one.messages for one in found.robots) == total


# -- periods, places, options


def test_a_period(of):
    since, until = START_NS + 10 * SECOND, START_NS + 20 * SECOND
    found = of(steady(GOOB), since_ns=since, until_ns=until)
    assert robot(found, GOOB).messages == 40
    assert (found.since_ns, found.until_ns) == (since, until - 250 * MS)


def test_a_file_that_is_being_written_is_read_and_not_indexed(tmp_path):
    folder, scratch = tmp_path / "recordings", tmp_path / "scratch"
    write_recording(folder / "a.mcap", steady(GOOB, seconds=2.0))
    write_recording(folder / "b.mcap.active", steady(FRED, seconds=3.0), finished=False)
    found = sources([folder], scratch)
    assert (len(found.indexes), found.robots) == (2, [FRED, GOOB])
    assert [path.name for path in folder.glob("*.parquet")] == ["a.parquet"]
    robots = {one.robot: one.messages for one in analyse(found, scratch).robots}
    assert robots == {GOOB: 8, FRED: 12}


def test_a_file_that_is_finished_meanwhile_is_found(tmp_path, monkeypatch):
    finished = write_recording(tmp_path / "a.mcap", steady(GOOB, seconds=2.0))
    gone = tmp_path / "a.mcap.active"
    monkeypatch.setattr(
        "pebble.extensions.recordings.traffic.sources.files", lambda _places: [gone, tmp_path / "deleted.mcap"]
    )
    assert len(sources([tmp_path], tmp_path / "scratch").indexes) == 1
    assert finished.exists()


def test_a_recording_that_was_deleted_still_counts(tmp_path):
    path = write_recording(tmp_path / "a.mcap", steady(GOOB, seconds=2.0))
    sources([tmp_path], tmp_path / "scratch")
    path.unlink()
    again = sources([tmp_path], tmp_path / "scratch")
    assert (len(again.indexes), again.robots) == (1, [GOOB])


def test_the_index_of_the_last_version_is_left_alone(tmp_path):
    write_recording(tmp_path / "a.mcap", steady(GOOB, seconds=2.0))
    old = tmp_path / "index" / "day=2025-11-20" / "robot=pebble%2Frobots%2Ffred" / "a.parquet"
    old.parent.mkdir(parents=True)
    old.write_bytes(b"rows of fred")
    assert sources([tmp_path], tmp_path / "scratch").robots == [GOOB]


def test_a_file_that_is_named_again_counts_once(tmp_path):
    path = write_recording(tmp_path / "a.mcap", steady(GOOB, seconds=2.0))
    assert len(sources([path, tmp_path, path], tmp_path / "scratch").indexes) == 1


def test_names_of_folders_are_no_patterns(tmp_path):
    folder, scratch = tmp_path / "it's [1] *?", tmp_path / "scratch"
    write_recording(folder / "a.mcap", steady(GOOB, seconds=2.0))
    assert analyse(sources([folder], scratch), scratch).robots[0].messages == 8


def test_a_damaged_index_is_named(tmp_path):
    write_recording(tmp_path / "a.mcap", steady(GOOB, seconds=2.0))
    found = sources([tmp_path], tmp_path / "scratch")
    found.indexes[0].write_bytes(b"no Parquet")
    with pytest.raises(PebbleError) as error:
        analyse(found, tmp_path / "scratch")
    assert "a.parquet" in str(error.value)
    assert "\n" not in str(error.value)
