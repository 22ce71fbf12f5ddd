"""Recordings as the server offers them to pages: over HTTP and a socket, read in processes of their own."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, Self

import av
import httpx
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from pebble.contract import CAPABILITIES
from pebble.errors import PebbleError
from pebble.extensions.media.decode import VideoDecoder
from pebble.extensions.page.recordings import archive_process, viewers
from pebble.extensions.page.recordings.playing import FOR_DECODER, MEDIUM, PICTURE, SOUND
from pebble.extensions.recordings.seek import questions
from pebble.extensions.recordings.traffic.index import index_path
from tests.ext.page import failing_jobs
from tests.ext.page.served import Served
from tests.ext.recordings.playing import GOOB, Line, js, ms, write
from tests.ext.recordings.seek.test_archive import FPS, SCENES, film
from tests.kit.scene import read_counter
from tests.support import Broker, gone, until

SECONDS = 20
DAY = "2023-11-14"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return film(tmp_path_factory.mktemp("recordings"), "h264", SECONDS)


@pytest.fixture(scope="module")
def archive(broker: Broker, folder: Path) -> Iterator[Served]:
    """A server with recordings; the process that reads them ends with it."""
    with Served(broker.port, recordings=folder) as running:
        yield running
        pids = running.app.state.recordings.process.pids
    assert until(lambda: all(map(gone, pids)))


def get(served: Served, path: str, **parameters: Any) -> httpx.Response:
    return httpx.get(f"{served.origin}/archive/{path}", params=parameters, timeout=30)


def post(served: Served, path: str, body: Any) -> httpx.Response:
    return httpx.post(f"{served.origin}/archive/{path}", json=body, headers={"origin": served.origin}, timeout=30)


def test_days_and_their_robots(archive: Served) -> None:
    (day,) = get(archive, "days").json()
    assert (day["day"], day["robots"], day["gaps"]) == (DAY, [GOOB], 0)
    assert (day["first"], day["last"]) == (ms(0), ms(SECONDS - 0.02))


def test_a_timeline_that_failed_stays_so_until_a_person_tries_again_and_is_indexed_once(
    archive: Served, folder: Path
) -> None:
    pytest.importorskip("duckdb")
    Path(archive.app.state.recordings.scratch).rmdir()  # as systems do with what is temporary
    for path in folder.rglob("*.mcap"):
        index_path(path).mkdir()
    asked = partial(get, archive, "timeline", day=DAY, robot=GOOB)

    def ended() -> httpx.Response:
        answers = [asked()]
        while answers[-1].status_code == 202:
            time.sleep(0.1)
            answers.append(asked())
        return answers[-1]

    for answer in (ended(), asked()):
        assert (answer.status_code, "Is a directory; move it away" in answer.text) == (422, True)
    for path in folder.rglob("*.parquet"):
        path.rmdir()
    assert asked().status_code == 422
    assert until(lambda: asked(again=1).status_code == 202)  # once the process of the job that failed has ended
    found = ended().json()
    assert (found["from"], found["step"]) == (ms(0), 10_000)
    online_driven_pictures_and_sound = 1 | 2 | 64 | 128
    assert [step & online_driven_pictures_and_sound for step in found["activity"]] == 2 * [195]
    assert [round(one["until"] - one["since"]) // 1000 for one in found["sessions"]] == [SECONDS + 10]
    assert len(list(folder.rglob("*.parquet"))) == 2
    assert asked().status_code == 200, "it is kept"


def exported(archive: Served, **options: Any) -> tuple[str, dict[str, Any]]:
    """Export a stretch; return its place, and how it ended."""
    answer = post(archive, "exports", {"robot": GOOB, "since": ms(5), "until": ms(10), "as": "mkv"} | options)
    assert answer.status_code == 202, answer.text
    place = f"exports/{answer.json()['id']}"
    assert until(lambda: get(archive, place).json()["state"] != "running", 60, step=0.1)
    return place, get(archive, place).json()


def test_a_stretch_is_exported_and_fetched(archive: Served, tmp_path: Path) -> None:
    place, state = exported(archive)
    assert (state["state"], state["why"], state["done"]) == ("ready", "", pytest.approx(1.0, abs=0.02))
    fetched = get(archive, f"{place}/file")
    assert "goob-20231114T221325Z.mkv" in fetched.headers["content-disposition"]
    assert len(fetched.content) == state["bytes"]
    target = tmp_path / "x.mkv"
    target.write_bytes(fetched.content)
    assert av.open(str(target)).duration / 1e6 == pytest.approx(5, abs=0.2)
    assert post(archive, f"{place}/end", {}).status_code == 200
    assert get(archive, place).status_code == 404


def test_one_export_at_a_time_it_can_be_ended_and_one_that_failed_has_a_reason(
    archive: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = {"robot": GOOB, "since": ms(0), "until": ms(SECONDS), "as": "mp4"}
    first = post(archive, "exports", wanted).json()["id"]
    assert post(archive, "exports", wanted).status_code == 409
    post(archive, f"exports/{first}/end", {})
    monkeypatch.setattr(questions, "export_job", failing_jobs.ended)
    _, state = exported(archive)
    assert (state["state"], state["why"]) == ("failed", "its process has ended (3): the log of the server says why")


def test_a_bad_question_gets_one_line(archive: Served) -> None:
    for robot, day, line in (("a/b/#", DAY, 'robot: "a/b/#" is none'), (GOOB, "../../etc", 'day: "../../etc" is none')):
        answer = get(archive, "timeline", robot=robot, day=day)
        assert (answer.status_code, answer.text.partition(": write")[0]) == (400, line)


def test_a_server_without_a_folder_has_no_recordings(broker: Broker) -> None:
    with Served(broker.port) as plain, plain.page() as page:
        assert get(plain, "days").status_code == 404
        assert page.welcome["recordings"] is False
        with pytest.raises((InvalidStatus, ConnectionClosed)):
            Viewer(plain).socket.recv(5)


def test_the_process_that_reads_is_replaced_if_it_dies(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "multiprocessing.py").write_text("raise SystemExit('of the folder that it was started in')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)

    async def run() -> None:
        process = archive_process.ArchiveProcess(folder)
        first = await process.ask(os.getpid)
        assert process.pids == [first]
        os.kill(first, signal.SIGKILL)
        with pytest.raises(PebbleError, match="the process that reads recordings has ended: try again"):
            await process.ask(os.getpid)
        assert await process.ask(os.getpid) != first
        process.close()

    asyncio.run(run())


# -- jobs that fail


def why(function: Callable[..., None]) -> str:
    """Return why a job failed, in a process of its own."""

    async def run() -> str:
        job = archive_process.Job(function)
        while job.running:
            await asyncio.sleep(0.02)
        return job.why

    return asyncio.run(run())


def test_a_job_that_is_killed_or_gives_no_sign_of_life_has_a_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    killed = "its process was killed, as it is where memory runs out: end other programs, or choose less"
    assert why(failing_jobs.killed) == killed
    monkeypatch.setattr(archive_process, "SILENT_S", 1.0)
    silent = "it did nothing for 1 s and was ended: look at the disk, then try again"
    assert why(failing_jobs.stopped) == silent


# -- the socket of a replay


SECONDS = 20


@pytest.fixture(scope="module")
def served(broker: Broker, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """Twenty seconds, twelve of nothing, and a message."""
    folder = film(tmp_path_factory.mktemp("recordings"), "pbvd", SECONDS)
    write(folder / "later.mcap", [Line(SECONDS + 12.0, f"{GOOB}/outgoing/sensors/imu", js(t=ms(140), n=1))])
    with Served(broker.port, recordings=folder) as running:
        yield running


class Viewer:
    """A page at a recording, as far as its socket goes."""

    def __init__(self, served: Served, at: float = 10.0, robot: str = GOOB) -> None:
        url = f"ws://127.0.0.1:{served.port}/ws/replay?robot={robot}&at={ms(at)}"
        self.socket = connect(url, origin=served.origin, max_size=None, open_timeout=50, ping_timeout=None)
        self.played: dict[str, Any] = {}
        self.skipped: list[float] = []
        self.values: dict[str, Any] = {}
        self.lines: list[Any] = []
        self.media: list[tuple[int, float, bytes]] = []
        self.bye = ""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    def send(self, **op: Any) -> None:
        self.socket.send(json.dumps(op))

    def until(self, condition: Any, seconds: float = 50.0) -> bool:
        """Read on until ``condition`` holds."""
        end = time.monotonic() + seconds
        while not condition():
            try:
                self._take(self.socket.recv(max(0.0, end - time.monotonic())))
            except (TimeoutError, ConnectionClosed):
                return bool(condition())
        return True

    def seek(self, at: float) -> None:
        self.send(op="seek", at=ms(at))
        assert self.until(lambda: self.played.get("begins") and abs(self.played["at"] - ms(at)) < 0.01)

    def shown(self) -> list[float]:
        return [at for what, at, _ in self.media if what == PICTURE]

    def _take(self, data: str | bytes) -> None:
        if isinstance(data, bytes):
            self.media.append((*MEDIUM.unpack_from(data), data[MEDIUM.size :]))
            return
        message = json.loads(data)
        if message["op"] == "played":
            self.played = message
            self.skipped = message.get("skipped") or self.skipped
            if message.get("begins"):
                self.values, self.lines, self.media = {}, [], []
        elif message["op"] == "state":
            self.values |= {metric: value for _, metric, value, _ in message["set"]}
        elif message["op"] == "logs":
            self.lines += [line["message"] for line in message["lines"]]
        else:
            self.bye = message["why"]


@pytest.fixture
def viewer(served: Served) -> Iterator[Viewer]:
    with Viewer(served) as made:
        assert made.until(lambda: made.shown() and made.values)
        yield made


def test_a_seek_is_followed_by_the_picture_and_the_state_of_that_time(viewer: Viewer) -> None:
    for at in (3.21, 13.5):
        viewer.seek(at)
        assert viewer.until(lambda: viewer.shown() and "web/liveness" in viewer.values)
        decoder = VideoDecoder()
        *_, newest = (decoder.feed(payload) for _, _, payload in viewer.media)
        number = int(at * FPS)
        assert newest is not None
        assert read_counter(newest.picture) == number % SCENES
        assert [what for what, *_ in viewer.media] == [FOR_DECODER] * (number % (2 * FPS)) + [PICTURE]
        assert viewer.values["sensors/imu"]["n"] == int(at * 10) * 5
        assert viewer.values["web/liveness"]["online"] is None  # one heartbeat is too few
        assert "drive-values" not in viewer.values
    assert viewer.until(lambda: viewer.lines == ["line 250"])


def test_it_is_played_at_its_speed_paused_and_leaves_gaps_out(viewer: Viewer) -> None:
    viewer.send(op="play", on=True)
    assert viewer.until(lambda: len(viewer.shown()) > 10)
    assert {what for what, *_ in viewer.media} >= {PICTURE, SOUND}
    assert viewer.until(lambda: viewer.values.get("web/liveness", {}).get("online") is True)
    viewer.send(op="play", on=False)
    assert viewer.until(lambda: viewer.played["on"] is False)
    at = viewer.played["at"]
    assert ms(10) < at < ms(SECONDS)
    viewer.send(op="speed", speed=8)
    viewer.send(op="play", on=True)
    assert viewer.until(lambda: viewer.played.get("ended"))
    assert viewer.played["speed"] == 8
    assert viewer.skipped == [pytest.approx(ms(SECONDS), abs=100), ms(SECONDS + 12)]
    assert viewer.until(lambda: viewer.values["sensors/imu"]["n"] == 1)
    viewer.seek(5.0)
    assert viewer.until(viewer.shown)


def test_a_recorded_robot_offers_nothing_that_obeys(served: Served, tmp_path: Path, broker: Broker) -> None:
    offers = {"drive": {"available": True, "topic": f"{GOOB}/incoming/drive-values"}, "lights": {"controls": True}}
    write(tmp_path / "a.mcap", [Line(1.0, CAPABILITIES.topic(GOOB), js(t=ms(1), value=offers), retain=True)])
    with Served(broker.port, recordings=tmp_path) as other, Viewer(other, 5.0) as viewer:
        assert viewer.until(lambda: viewer.values)
        value = viewer.values["capabilities"]["value"]
        assert value["drive"] == {"available": False, "topic": "replay/robots/goob/incoming/drive-values"}
        assert value["lights"] == {"controls": False}


DRIVE = json.dumps({"op": "drive", "ref": GOOB, "g": 1, "t": 1.0, "x": 1.0, "z": 1.0})


@pytest.mark.parametrize("data", [DRIVE, json.dumps({"op": "seek", "at": -1}), "[" * 9000, b"\0\0\0\1\0"])
def test_all_but_seek_play_and_speed_ends_it(served: Served, data: str | bytes) -> None:
    with Viewer(served) as viewer:
        viewer.socket.send(data)
        assert viewer.until(lambda: viewer.bye)
        assert viewer.bye.startswith("a recording takes seek, play and speed only")


def test_processes_are_few_and_end_with_their_sockets(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    processes = served.app.state.recordings.viewers.processes
    assert until(lambda: not processes)
    monkeypatch.setattr(viewers, "MOST", 2)
    with Viewer(served) as one, Viewer(served) as two:
        assert one.until(one.shown)
        assert two.until(two.shown)
        pids = [process.pid for process in processes]
        with Viewer(served) as third:
            assert third.until(lambda: third.bye.startswith("2 pages look at recordings already"))
        next(iter(processes)).kill()
        assert until(lambda: one.until(lambda: one.bye, 1) or two.until(lambda: two.bye, 1))
    assert until(lambda: not processes and all(map(gone, pids)))


def test_a_page_without_a_question_gets_none(served: Served) -> None:
    for query in ("robot=goob&at=1", f"robot={GOOB}&at=soon"):
        with pytest.raises((InvalidStatus, ConnectionClosed)):
            connect(f"ws://127.0.0.1:{served.port}/ws/replay?{query}", origin=served.origin).recv(5)
