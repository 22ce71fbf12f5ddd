"""What was at any moment of a recording, against a naive reading of all of it."""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from pebble.extensions.media.decode import VideoDecoder
from pebble.extensions.media.scene import Scene
from pebble.extensions.media.video import make_encoder
from pebble.extensions.recordings.files.recorded import Recorded, finished_path
from pebble.extensions.recordings.library import files, merged
from pebble.extensions.recordings.recorder.folder import Folder
from pebble.extensions.recordings.recorder.lane import CARRIED, Item, OpenFile
from pebble.extensions.recordings.seek.archive import Archive
from pebble.extensions.recordings.seek.days import Days
from tests.ext.recordings.playing import FRED, GOOB, THEN_NS, Line, demo, js, ms, write
from tests.kit.scene import read_counter

SECONDS = 30
FPS = 15
SIZE = (320, 240)
SCENES = 60  # after which pictures repeat: drawing takes longer than all else
CAMERA = f"{GOOB}/outgoing/front-camera"


def pictures(encoding: str, seconds: float) -> Iterator[Line]:
    """The number in a picture is its own modulo SCENES."""
    encoder = make_encoder(encoding, fps=FPS, quality=60, keyframe_interval=2 * FPS)
    scene, made = Scene(*SIZE), list[np.ndarray]()
    for number in range(SCENES):
        made.append(np.empty((SIZE[1], SIZE[0], 3), np.uint8))
        scene.render(number, made[-1])
    for number in range(int(seconds * FPS)):
        at = number / FPS
        payload = encoder.encode(made[number % SCENES], ms(at))
        if payload is not None:
            yield Line(at, CAMERA, payload)


def film(root: Path, encoding: str, seconds: float, *, finished: bool = True) -> Path:
    """A folder as a recorder leaves it: one file of state, one of media, a chunk each second."""
    day = root / "2023/11/14"
    capabilities = js(t=ms(0), value={"video": {"available": True}, "audio": {"available": True}})
    offered = Line(0.0, f"{GOOB}/outgoing/capabilities", capabilities, 1, retain=True)
    shown = [offered, *demo(seconds, [GOOB]), *pictures(encoding, seconds)]
    lines = sorted(shown, key=lambda line: line.at)
    media = [line for line in lines if line.topic in (CAMERA, f"{GOOB}/outgoing/audio")]
    state = [line for line in lines if line.topic not in (CAMERA, f"{GOOB}/outgoing/audio")]
    suffix = ".mcap" if finished else ".mcap.active"
    write(day / f"20231114T221320Z-000001.state{suffix}", state, finished=finished, chunk_ns=10**9)
    name = f"20231114T221320Z-000002.media.{GOOB.replace('/', '.')}{suffix}"
    write(day / name, media, finished=finished, chunk_ns=10**9)
    return root


@pytest.fixture(scope="module", params=["finished", "being written"])
def folder(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return film(tmp_path_factory.mktemp("film"), "pbvd", SECONDS, finished=request.param == "finished")


@pytest.fixture
def archive(folder: Path) -> Iterator[Archive]:
    made = Archive(folder)
    yield made
    made.close()


@pytest.fixture(scope="module")
def everything(folder: Path) -> list[Recorded]:
    return list(merged(files([folder])))


def at_ns(seconds: float) -> int:
    return THEN_NS + round(seconds * 1e9)


#: At random and at messages.
MOMENTS = [*(at_ns(random.Random(seed).uniform(0.5, SECONDS)) for seed in range(25)), at_ns(12)]


def texts(messages: list[Recorded]) -> list[tuple[int, str, bytes]]:
    return [(one.log_ns, one.channel.topic, one.payload) for one in messages]


def test_a_period_holds_exactly_its_messages(archive: Archive, everything: list[Recorded]) -> None:
    for begin in MOMENTS:
        end = begin + 2 * 10**9
        wanted = [one for one in everything if begin <= one.log_ns < end]
        assert sorted(texts(archive.messages(GOOB, begin, end))) == sorted(texts(wanted))
        assert not archive.messages(FRED, begin, end)


def test_the_state_is_the_newest_value_of_each_topic(archive: Archive, everything: list[Recorded]) -> None:
    for at in MOMENTS:
        newest = {
            one.channel.topic: one
            for one in everything
            if one.log_ns < at and one.channel.topic not in (CAMERA, f"{GOOB}/outgoing/audio")
        }
        assert sorted(texts(archive.state(GOOB, at))) == sorted(texts(list(newest.values())))


def test_what_was_carried_into_a_file_is_state_and_no_message(tmp_path: Path) -> None:
    folder = Folder(tmp_path / "own")
    folder.take()
    lane = OpenFile(folder, "state", THEN_NS, {})
    lane.add(Item(0, f"{GOOB}/outgoing/status", b'{"n": 1}', 1, True, CARRIED), THEN_NS)
    lane.add(Item(0, f"{GOOB}/outgoing/online", b'{"t": 1}', 1, True, ""), THEN_NS + 10**9)
    lane.finish()
    folder.release()
    archive = Archive(tmp_path / "own")
    assert [one.channel.topic for one in archive.messages(GOOB, 0, 1 << 62)] == [f"{GOOB}/outgoing/online"]
    assert [one.payload for one in archive.state(GOOB, THEN_NS + 10**9)] == [b'{"n": 1}']
    assert archive.next_ns(GOOB, 0) == THEN_NS + 10**9
    archive.close()


def test_log_lines_before_a_time_are_there(archive: Archive) -> None:
    lines = archive.log_lines(GOOB, THEN_NS + 26 * 10**9)
    assert [one.payload.split(b'"')[-2] for one in lines] == [b"line 250", b"line 750", b"line 1250"]


@pytest.mark.parametrize("encoding", ["json", "pbvd", "h264"])
def test_the_picture_at_a_time_is_the_one_that_was_there(tmp_path: Path, encoding: str) -> None:
    archive = Archive(film(tmp_path, encoding, 10))
    chance = random.Random(3)
    for _ in range(8):
        number = chance.randrange(10 * FPS)
        decoder = VideoDecoder()
        *_, made = (decoder.feed(one.payload) for one in archive.pictures(GOOB, at_ns(number / FPS + 0.02)))
        assert made is not None
        assert read_counter(made.picture) == number % SCENES
        assert abs((made.captured_ms or 0) - ms(number / FPS)) <= 1
    assert archive.pictures(GOOB, at_ns(-1)) == []
    assert archive.pictures(GOOB, at_ns(30)) == [], "an old picture is shown as one of this time"
    archive.close()


def test_a_day_names_its_robots_and_gaps(tmp_path: Path) -> None:
    gap = Line(5.0, "$recorder/events", js(t=ms(5), event="gap", since=ms(4), until=ms(5), why="lost"))
    path = write(tmp_path / "a.mcap", [Line(0.0, f"{GOOB}/outgoing/online", js(t=ms(0))), gap])
    (day,) = Days(Archive(tmp_path)).all()
    assert (day.day, day.robots, day.bytes, day.gaps) == ("2023-11-14", [GOOB], path.stat().st_size, 1)
    assert (day.first, day.last) == (ms(0), ms(5))


def test_a_file_that_is_finished_meanwhile_is_read_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    archive = Archive(film(tmp_path, "pbvd", 6, finished=False))
    before = texts(archive.messages(GOOB, 0, 1 << 62))
    for path in tmp_path.rglob("*.active"):
        path.rename(finished_path(path))
    monkeypatch.setattr("pebble.extensions.recordings.seek.archive.LIST_S", 0.0)
    assert before
    assert texts(archive.messages(GOOB, 0, 1 << 62)) == before
    archive.close()
