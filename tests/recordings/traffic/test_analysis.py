"""The analysis gives what a plain computation over the messages gives, and knows whose fault an outage is."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path

import pytest

from pebble.contract.packets import Codec, Picture, PictureKind, Sound
from pebble.errors import PebbleError
from pebble.recordings.files.recorded import Recorded
from pebble.recordings.library import FOREVER_NS, merged
from pebble.recordings.traffic.analysis import analyse
from pebble.recordings.traffic.results import (
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
from pebble.recordings.traffic.shared_outages import Presence, shared
from pebble.recordings.traffic.sources import sources
from tests.recordings.synthetic import FLEET, START_NS, Robot, Sent, event, traffic, write_recording

pytest.importorskip("duckdb")

SECOND, MS = 10**9, 10**6
GOOB, FRED, MINILAMP, BENJR = (robot.base for robot in FLEET)


def analysed(folder: Path, messages: Iterable[Sent], scratch: Path, **options: object) -> Traffic:
    write_recording(folder / "x.mcap", messages)
    found = sources([folder], scratch, since_ns=0, until_ns=FOREVER_NS)
    return analyse(found, scratch, **options)


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
    assert one.intervals.count == len(intervals)
    assert one.intervals.median_ms == pytest.approx(usual)
    assert one.intervals.p95_ms == pytest.approx(percentile(intervals, 0.95))
    assert one.intervals.p99_ms == pytest.approx(percentile(intervals, 0.99))
    assert one.intervals.longest_ms == pytest.approx(max(intervals))
    assert [outage.since_ns for outage in one.outages] == [since for since, _ in outages]
    assert [outage.length_ms for outage in one.outages] == pytest.approx([length for _, length in outages])


@pytest.mark.parametrize("base", [one.base for one in FLEET])
def test_latency(minute, base):
    path, found = minute
    latencies = [(message.log_ns - message.publish_ns) / MS for message in messages_of(path, base, "outgoing/online")]
    one = robot(found, base).latency
    assert one.count == len(latencies) == sum(one.histogram.counts)
    assert [one.floor_ms, one.median_ms, one.p95_ms, one.p99_ms] == pytest.approx(
        [percentile(latencies, share) for share in (0.01, 0.5, 0.95, 0.99)]
    )


def test_loss_and_jitter(minute):
    path, found = minute
    packets = messages_of(path, GOOB, "outgoing/audio")
    sounds = [Sound.unpack(message.payload) for message in packets]
    steps = [after.sequence - before.sequence for before, after in pairwise(sounds)]
    received = [(after.log_ns - before.log_ns) / MS for before, after in pairwise(packets)]
    captured = [after.captured_ms - before.captured_ms for before, after in pairwise(sounds)]
    jitter = [abs(one - other) for one, other in zip(received, captured, strict=True)]
    audio = next(stream for stream in robot(found, GOOB).streams if stream.metric == "audio")
    assert (audio.messages, audio.lost, audio.restarts) == (len(packets), sum(step - 1 for step in steps), 0)
    assert audio.lost == 14
    assert audio.jitter_median_ms == pytest.approx(percentile(jitter, 0.5))
    assert audio.jitter_p95_ms == pytest.approx(percentile(jitter, 0.95))
    assert audio.encodings == ["pcm"]


# -- what robots are like


def test_kinds_of_robots(minute):
    kinds = {one.robot: one.machine for one in minute[1].robots}
    assert kinds == {GOOB: LINUX, FRED: LINUX, MINILAMP: MCU, BENJR: MCU}


def test_a_component_without_heartbeats(of):
    found = of([Sent(START_NS, "pebble/infrastructure/mast/outgoing/charging-level", b"{}")]).robots[0]
    assert (found.machine, found.intervals, found.latency, found.outages) == (COMPONENT, None, None, [])


def test_whole_second_stamps_are_named_and_nothing_is_corrected(minute):
    named = {one.robot: one.latency.whole_seconds for one in minute[1].robots}
    assert named == {GOOB: False, FRED: False, MINILAMP: True, BENJR: True}
    assert robot(minute[1], BENJR).latency.median_ms > 300


def test_heartbeats_that_happen_on_the_second_are_not_named(of):
    found = of(heartbeats(GOOB, [number * 0.25 for number in range(200)]))
    assert robot(found, GOOB).latency.whole_share == pytest.approx(0.25)
    assert not robot(found, GOOB).latency.whole_seconds


def test_a_clock_that_is_ahead_is_named(minute):
    ahead = {one.robot: one.latency.ahead_ms for one in minute[1].robots}
    assert ahead[FRED] == pytest.approx(220, abs=2)
    assert ahead[GOOB] == 0


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


def causes(found: Traffic) -> dict[str, list[str]]:
    return {one.robot: [outage.cause for outage in one.outages] for one in found.robots}


def test_the_planted_outage_is_shared_and_others_are_not(minute):
    assert causes(minute[1]) == {GOOB: ["shared", "robot"], FRED: ["shared"], MINILAMP: ["shared"], BENJR: ["robot"]}


def test_the_length_of_an_outage_is_beyond_the_usual(of):
    found = robot(of(steady(GOOB, (20.0, 22.0))), GOOB)
    assert [outage.length_ms for outage in found.outages] == [1750.0]
    assert found.outages[0].since_ns == START_NS + 20 * SECOND


def test_an_interval_of_up_to_one_and_a_half_is_none(of):
    times = [number * 0.25 for number in range(20)] + [4.75 + 0.375 + number * 0.25 for number in range(20)]
    assert robot(of(heartbeats(GOOB, times)), GOOB).outages == []


def presence(*outages: float, online: tuple[float, float] = (0.0, 60.0), interval_s: float = 0.25) -> Presence:
    """A robot with outages that begin at these seconds."""
    span = round(online[0] * SECOND), round(online[1] * SECOND)
    return Presence(interval_s * SECOND, [span], [round(at * SECOND) for at in outages])


STEADY = presence()


@pytest.mark.parametrize(
    ("robots", "expected"),
    [
        ([presence(20.0)], [[False]]),  # alone
        ([presence(20.0), presence(20.3)], [[True], [True]]),
        ([presence(20.0), presence(20.6)], [[False], [False]]),
        ([presence(20.0), STEADY], [[False], []]),
        ([presence(20.0), presence(20.0), STEADY, STEADY], [[True], [True], [], []]),
        ([presence(20.0), presence(20.0), STEADY, STEADY, STEADY], [[False], [False], [], [], []]),
        ([presence(20.0), presence(20.0), *[presence(online=(0.0, 10.0))] * 5], [[True], [True], *[[]] * 5]),
        ([presence(20.0), presence(20.0), *[presence(online=(30.0, 60.0))] * 5], [[True], [True], *[[]] * 5]),
        ([presence(5.0, 20.0, 40.0), presence(20.0, 30.0)], [[False, True, False], [True, False]]),
        ([presence(20.0), presence(18.5, interval_s=2.0)], [[True], [True]]),  # a slow heartbeat misses it later
    ],
)
def test_outages_are_shared_by_at_least_half_of_the_robots_that_were_online(robots, expected):
    assert shared(robots) == expected


def test_above_a_minute_a_robot_was_offline(of):
    found = robot(of(steady(GOOB, (20.0, 90.0), seconds=120.0)), GOOB)
    assert (found.offline, found.offline_s, found.outages) == (1, 70.0, [])
    assert found.intervals.longest_ms == 250.0
    assert found.idle_s == 21 + 30


def test_what_was_not_recorded_is_no_outage(of):
    gap = event(START_NS + 22 * SECOND, "gap", since=START_NS // MS + 20_100, until=START_NS // MS + 21_900, why="lost")
    found = of(ordered(steady(GOOB, (20.0, 22.0), (40.0, 41.0)), [gap]))
    assert [outage.length_ms for outage in robot(found, GOOB).outages] == [750.0]
    assert [(one.until_ns - one.since_ns, one.why) for one in found.gaps] == [(1800 * MS, "lost")]


@pytest.mark.parametrize("name", ["start", "clock"])
def test_nothing_is_measured_across_a_start_of_the_recorder(of, name):
    noted = event(START_NS + 21 * SECOND, name)
    assert robot(of(ordered(steady(GOOB, (20.0, 22.0)), [noted])), GOOB).outages == []


def test_a_recorder_that_was_late_is_named(of):
    late = event(START_NS + 22 * SECOND, "late", max_ms=1500)
    assert causes(of(ordered(steady(GOOB, (20.0, 22.0), (40.0, 41.0)), [late]))) == {GOOB: ["recorder", "robot"]}


def test_messages_that_were_dropped_are_counted(of):
    noted = [event(START_NS, "dropped", messages=7, why="the disk is too slow")]
    gap = [event(START_NS + SECOND, "gap", since=START_NS // MS, until=START_NS // MS + 1000, why="full", messages=5)]
    assert of([*noted, *gap, *heartbeats(GOOB, [2.0])]).dropped == 12


def test_the_last_heartbeat_of_a_connection_does_not_count(of):
    will = Sent(START_NS + 10 * SECOND + 100 * MS, f"{GOOB}/outgoing/online", b'{"t": 5, "online": false}')
    assert robot(of(ordered(steady(GOOB), [will])), GOOB).intervals.count == 239


def test_the_older_name_of_the_heartbeat(of):
    older = [Sent(sent.ns, sent.topic.replace("online", "heartbeat"), sent.payload) for sent in steady(GOOB)]
    assert robot(of(older), GOOB).intervals.median_ms == 250.0


def test_both_names_of_the_heartbeat_count_once(of):
    both = [Sent(sent.ns + MS, sent.topic.replace("online", "heartbeat"), sent.payload) for sent in steady(GOOB)]
    assert robot(of(ordered(steady(GOOB), both)), GOOB).intervals.median_ms == 250.0


# -- sessions


def drive(*times: float, moving: bool = True) -> list[Sent]:
    payload = b'{"x":0,"z":0.5}' if moving else b'{"x":0,"z":0}'
    return [Sent(START_NS + round(at * SECOND), f"{GOOB}/incoming/drive-values", payload) for at in times]


def sessions(found: Traffic) -> list[tuple[int, int]]:
    start = START_NS // SECOND
    return [(one.since_s - start, one.until_s - start) for one in robot(found, GOOB).sessions]


def test_a_session_has_margins(of):
    assert sessions(of(drive(10.0, 11.0, 30.5))) == [(5, 36)]


def test_breaks_of_two_minutes_belong_to_a_session(of):
    assert sessions(of(drive(10.0, 130.0))) == [(5, 136)]
    assert sessions(of(drive(10.0, 131.0))) == [(5, 16), (126, 137)]


def test_a_robot_at_rest_is_not_used(of):
    assert sessions(of(drive(10.0, moving=False))) == []


def test_a_warning_is_no_session(of):
    assert sessions(of([Sent(START_NS, f"{GOOB}/outgoing/logs", b'{"level":"ERROR"}')])) == []


def test_bandwidths_of_sessions_and_of_idle_time_are_apart(minute):
    goob = robot(minute[1], GOOB)
    assert (goob.session_s, goob.sessions[0].activities) == (40, ["drive", "media"])
    assert goob.idle_s == 60 - 40
    assert goob.of(VIDEO, IDLE) is None
    assert goob.of(TOTAL, IDLE).median_kbps < 3 < 300 < goob.of(TOTAL, SESSION).median_kbps
    both = goob.of(TOTAL, SESSION), goob.of(TOTAL, IDLE)
    assert sum(one.bytes for one in both) == goob.of(TOTAL, ALL).bytes == goob.bytes


def test_sound_sent_to_a_robot_is_not_its_audio(of):
    packet = Sound(Codec.OPUS, 1, 48000, 960, 1, START_NS // MS, b"opus").pack()
    found = robot(of([Sent(START_NS, f"{GOOB}/incoming/audio-stream", packet)]), GOOB)
    assert found.of(VOICE).messages == 1
    assert found.of(AUDIO) is None
    assert found.streams == []


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


# -- numbers of media


def pictures(*numbers: int, kind: PictureKind = PictureKind.H264) -> list[bytes]:
    return [Picture(kind, number % 2**32, START_NS // MS, b"").pack() for number in numbers]


def sounds(*numbers: int) -> list[bytes]:
    return [Sound(Codec.PCM16LE, 1, 16000, 1, number, START_NS // MS, b"\0\0").pack() for number in numbers]


#: Payloads, and how many are lost and how often numbers begin anew.
NUMBERED = {
    "left out": (pictures(1, 2, 3, 7), 3, 0),
    "restart": (pictures(1, 2, 1, 2), 0, 1),
    "the same again": (pictures(5, 5), 0, 1),
    "many left out": (pictures(1, 1000), 998, 0),
    "too many for a loss": (pictures(1, 1002), 0, 1),
    "pictures go on with 0": (pictures(2**32 - 2, 2**32 - 1, 0, 1), 0, 0),
    "pictures lost where they wrap": (pictures(2**32 - 1, 2), 2, 0),
    "sound goes on with 1": (sounds(2**32 - 1, 1, 2), 0, 0),
    "sound lost where it wraps": (sounds(2**32 - 2, 3), 3, 0),
    "another encoding": (pictures(1, 2, kind=PictureKind.JPEG) + pictures(8, 9), 0, 1),
    "differences are numbered with full pictures": (
        pictures(1, kind=PictureKind.JPEG) + pictures(2, 5, kind=PictureKind.DELTA_JPEG), 2, 0,
    ),
}  # fmt: skip


def test_numbers_that_are_left_out_are_lost(of):
    found = of(
        Sent(START_NS + number * MS, f"{GOOB}/outgoing/{name}", payload)
        for name, (payloads, _, _) in NUMBERED.items()
        for number, payload in enumerate(payloads)
    )
    streams = {one.metric: (one.messages, one.lost, one.restarts) for one in robot(found, GOOB).streams}
    expected = {name: (len(payloads), lost, restarts) for name, (payloads, lost, restarts) in NUMBERED.items()}
    assert streams == expected


# -- periods, places, options


def test_a_period(of):
    since, until = START_NS + 10 * SECOND, START_NS + 20 * SECOND
    found = of(steady(GOOB), since_ns=since, until_ns=until)
    assert robot(found, GOOB).messages == 40
    assert (found.since_ns, found.until_ns) == (since, until - 250 * MS)


def test_a_period_without_messages_is_refused(of):
    with pytest.raises(PebbleError, match="no message"):
        of(steady(GOOB), until_ns=START_NS)


def test_overhead_adds_topics_and_headers(of):
    found = robot(of(steady(GOOB, seconds=1.0), overhead=True), GOOB)
    size = len(f"{GOOB}/outgoing/online") + len(b'{"t": 1763600400000, "online": true}') + 4 + 40
    assert found.of(HEARTBEATS).bytes == 4 * size
    assert found.bytes == 4 * 36


def test_overhead_counts_a_header_for_each_segment(of):
    found = robot(of([Sent(START_NS, f"{GOOB}/outgoing/front-camera", bytes(3000))], overhead=True), GOOB)
    assert found.of(VIDEO).bytes == 3000 + len(f"{GOOB}/outgoing/front-camera") + 4 + 3 * 40


def test_only_some_robots(tmp_path):
    write_recording(tmp_path / "x.mcap", traffic(seconds=2.0))
    found = sources([tmp_path], tmp_path / "scratch", robots=[GOOB], since_ns=0, until_ns=FOREVER_NS)
    assert list(found.parts) == [GOOB]


def test_only_the_days_of_the_period(tmp_path):
    day = 86_400 * SECOND
    write_recording(
        tmp_path / "x.mcap", [Sent(START_NS + days * day, f"{GOOB}/outgoing/status", b"{}") for days in range(3)]
    )
    found = sources([tmp_path], tmp_path / "scratch", since_ns=START_NS + day, until_ns=START_NS + day + SECOND)
    assert len(found.parts[GOOB]) == 1


def test_a_file_that_is_being_written_is_read_and_not_indexed(tmp_path):
    folder, scratch = tmp_path / "recordings", tmp_path / "scratch"
    write_recording(folder / "a.mcap", steady(GOOB, seconds=2.0))
    write_recording(folder / "b.mcap.active", steady(FRED, seconds=3.0), finished=False)
    found = sources([folder], scratch, since_ns=0, until_ns=FOREVER_NS)
    assert (found.recordings, set(found.parts)) == (2, {GOOB, FRED})
    assert [path.name for path in (folder / "index" / "recordings").iterdir()] == ["a.json"]
    robots = {one.robot: one.messages for one in analyse(found, scratch).robots}
    assert robots == {GOOB: 8, FRED: 12}


def test_a_file_that_is_finished_meanwhile_is_found(tmp_path, monkeypatch):
    finished = write_recording(tmp_path / "a.mcap", steady(GOOB, seconds=2.0))
    gone = tmp_path / "a.mcap.active"
    monkeypatch.setattr("pebble.recordings.traffic.sources.files", lambda _places: [gone, tmp_path / "deleted.mcap"])
    found = sources([tmp_path], tmp_path / "scratch", since_ns=0, until_ns=FOREVER_NS)
    assert found.recordings == 1
    assert finished.exists()


def test_a_recording_that_was_deleted_still_counts(tmp_path):
    path = write_recording(tmp_path / "a.mcap", steady(GOOB, seconds=2.0))
    sources([tmp_path], tmp_path / "scratch", since_ns=0, until_ns=FOREVER_NS)
    path.unlink()
    again = sources([tmp_path], tmp_path / "scratch", since_ns=0, until_ns=FOREVER_NS)
    assert (again.recordings, list(again.parts)) == (1, [GOOB])


def test_a_day_of_an_archive_uses_the_index_of_the_archive(tmp_path):
    write_recording(tmp_path / "2025/11/20/a.mcap", steady(GOOB, seconds=2.0))
    write_recording(tmp_path / "2025/11/21/b.mcap", steady(FRED, seconds=2.0))
    sources([tmp_path], tmp_path / "scratch", since_ns=0, until_ns=FOREVER_NS)
    found = sources([tmp_path / "2025/11/20"], tmp_path / "scratch", since_ns=0, until_ns=FOREVER_NS)
    assert list(found.parts) == [GOOB]
    assert not (tmp_path / "2025/11/20/index").exists()


def test_a_file_alone_is_not_indexed_beside_it(tmp_path):
    path = write_recording(tmp_path / "a.mcap", steady(GOOB, seconds=2.0))
    found = sources([path, path, tmp_path / "a.mcap"], tmp_path / "scratch", since_ns=0, until_ns=FOREVER_NS)
    assert found.recordings == 1
    assert not (tmp_path / "index").exists()


def test_files_of_several_folders(tmp_path):
    paths = [write_recording(tmp_path / base[-4:] / "same.mcap", steady(base, seconds=2.0)) for base in (GOOB, FRED)]
    found = sources(paths, tmp_path / "scratch", since_ns=0, until_ns=FOREVER_NS)
    assert set(found.parts) == {GOOB, FRED}
    assert len({path for parts in found.parts.values() for path in parts}) == 2


def test_a_folder_without_recordings_is_refused(tmp_path):
    with pytest.raises(PebbleError, match="there is no recording"):
        sources([tmp_path], tmp_path / "scratch", since_ns=0, until_ns=FOREVER_NS)


def test_names_of_folders_are_no_patterns(tmp_path):
    folder, scratch = tmp_path / "it's [1] *?", tmp_path / "scratch"
    write_recording(folder / "a.mcap", steady(GOOB, seconds=2.0))
    found = sources([folder], scratch, since_ns=0, until_ns=FOREVER_NS)
    assert analyse(found, scratch).robots[0].messages == 8


def test_a_damaged_index_is_named(tmp_path):
    write_recording(tmp_path / "a.mcap", steady(GOOB, seconds=2.0))
    found = sources([tmp_path], tmp_path / "scratch", since_ns=0, until_ns=FOREVER_NS)
    found.parts[GOOB][0].write_bytes(b"no Parquet")
    with pytest.raises(PebbleError) as error:
        analyse(found, tmp_path / "scratch")
    assert "a.parquet" in str(error.value)
    assert "\n" not in str(error.value)


def test_robots_are_analysed_in_order_of_their_names(of):
    robots = [Robot("b"), Robot("a")]
    assert [one.robot for one in of(traffic(robots, seconds=2.0)).robots] == ["pebble/robots/a", "pebble/robots/b"]
