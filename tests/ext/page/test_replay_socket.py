"""The socket of a replay: what a page is sent of a recording, and what it may ask for."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self, get_args

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from pebble.contract import CAPABILITIES
from pebble.extensions.media.decode import VideoDecoder
from pebble.extensions.page import messages as m
from pebble.extensions.page.recordings import viewers
from pebble.extensions.page.recordings.playing import FOR_DECODER, MEDIUM, PICTURE, SOUND
from tests.ext.page.served import Served
from tests.ext.recordings.playing import GOOB, Line, js, ms, write
from tests.ext.recordings.seek.filming import FPS, SCENES, film
from tests.kit.scene import read_counter
from tests.support import Broker, gone, until

SECONDS = 20


@pytest.fixture(scope="module")
def served(broker: Broker, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """Twenty seconds, two minutes of nothing, and a message."""
    folder = film(tmp_path_factory.mktemp("recordings"), "pbvd", SECONDS)
    write(folder / "later.mcap", [Line(SECONDS + 120.0, f"{GOOB}/outgoing/sensors/imu", js(t=ms(140), n=1))])
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
    for at in (13.5, 3.21, 19.0):
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
    assert viewer.until(lambda: viewer.lines == ["line 250", "line 750"])


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
    assert viewer.skipped == [pytest.approx(ms(SECONDS), abs=100), ms(SECONDS + 120)]
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


OTHERS = [{"op": struct.__struct_config__.tag, "ref": GOOB} for struct in get_args(m.FromPage)]


@pytest.mark.parametrize(
    "text",
    [
        *map(json.dumps, OTHERS),
        json.dumps({"op": "drive", "ref": GOOB, "g": 1, "t": 1.0, "x": 1.0, "z": 1.0}),
        json.dumps({"op": "estop", "ref": ""}),
        json.dumps({"op": "seek", "at": -1}),
        json.dumps({"op": "speed", "speed": 1000}),
        "[" * 9000,
        b"\x00\x00\x00\x01\x00",
    ],
    ids=lambda text: str(text)[:24],
)
def test_all_but_seek_play_and_speed_ends_it(served: Served, text: str | bytes) -> None:
    with Viewer(served) as viewer:
        viewer.socket.send(text)
        assert viewer.until(lambda: viewer.bye)
        assert viewer.bye.startswith("a recording takes seek, play and speed only")


def test_processes_are_few_and_end_with_their_sockets(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    processes = served.app.state.recordings.viewers.processes
    assert until(lambda: not processes, 10)
    monkeypatch.setattr(viewers, "MOST", 2)
    with Viewer(served) as one, Viewer(served) as two:
        assert one.until(one.shown)
        assert two.until(two.shown)
        pids = [process.pid for process in processes]
        with Viewer(served) as third:
            assert third.until(lambda: third.bye.startswith("2 pages look at recordings already"))
        next(iter(processes)).kill()
        assert one.until(lambda: one.bye, 2) or two.until(lambda: two.bye, 2)
    assert until(lambda: not processes and all(map(gone, pids)), 10)


def test_a_page_without_session_or_question_gets_none(broker: Broker, served: Served) -> None:
    for where, query in ((served, "robot=goob&at=1"), (served, f"robot={GOOB}&at=soon")):
        with pytest.raises((InvalidStatus, ConnectionClosed)):
            connect(f"ws://127.0.0.1:{where.port}/ws/replay?{query}", origin=where.origin).recv(5)
    with Served(broker.port) as plain, pytest.raises((InvalidStatus, ConnectionClosed)):
        Viewer(plain).socket.recv(5)
