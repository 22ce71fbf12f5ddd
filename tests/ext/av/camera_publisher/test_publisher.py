"""The publisher: its parts, full pictures on request, and frames that turn bad while looked at; then as a process."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from queue import Empty, Queue
from typing import Any

import cv2
import numpy as np
import pytest

from pebble.config import parse
from pebble.errors import PayloadError, PebbleError
from pebble.extensions.media.decode import Decoded, VideoDecoder
from pebble.extensions.media.frames import Frame, FrameInfo
from pebble.extensions.media.scene import Scene
from pebble.extensions.media.video import make_encoder
from pebble.services.camera_publisher import service as module
from pebble.services.camera_publisher.frame_selector import KeyframeRequests
from pebble.services.camera_publisher.rate_control import wire_size
from pebble.services.camera_publisher.service import CameraPublisher
from pebble.services.camera_publisher.shape import Shape
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.ext.av.media_rig import Device, MediaProgram, Operator
from tests.kit.robot import BASE, ROBOT, Listener, Running
from tests.kit.scene import read_counter
from tests.support import Broker, until


def frame(form: str = "bgr24") -> Frame:
    """Red in its upper left quarter, black elsewhere."""
    picture = np.zeros((48, 64, 3), np.uint8)
    picture[:24, :32] = (0, 0, 255)
    packed = {"bgr24": np.ravel, "mjpeg": lambda made: cv2.imencode(".jpg", made)[1].reshape(-1)}
    info = FrameInfo(captured_ns=1, captured_ms=1, format=form, width=64, height=48)
    return Frame(info, packed[form](picture), shared=False)


def test_requests_for_a_full_picture_are_answered_once_a_second() -> None:
    """A key frame that the encoder makes by itself answers them as well; what the sender needs is not rationed."""
    keyframes, answers = KeyframeRequests(), []
    for tick in range(300):
        keyframes.request()
        if keyframes.due(tick / 100):
            keyframes.sent(tick / 100)
            answers.append(tick)
    assert answers == [0, 100, 200]
    keyframes.request()
    keyframes.sent(5.0)
    assert not keyframes.due(7.0)
    keyframes.require()
    assert keyframes.due(7.1)


@pytest.mark.parametrize("form", ["bgr24", "mjpeg"])
@pytest.mark.parametrize(
    ("turn", "corner"), [(0, (False, False)), (90, (False, True)), (180, (True, True)), (270, (True, False))]
)
def test_pictures_are_turned_clockwise(form: str, turn: int, corner: tuple[bool, bool]) -> None:
    picture = Shape(None, None, turn).picture(frame(form))
    assert picture.shape == ((48, 64, 3) if turn in (0, 180) else (64, 48, 3))
    rows, columns = np.nonzero(picture[:, :, 2] > 128)  # where it is red: in the lower half, in the right half
    assert (rows.mean() > picture.shape[0] / 2, columns.mean() > picture.shape[1] / 2) == corner


@pytest.mark.parametrize(
    ("width", "height", "turn", "part", "size"),
    [
        (None, None, 0, "1", (64, 48)),
        (32, None, 0, "1", (32, 24)),
        (None, 24, 0, "1", (32, 24)),
        (32, 20, 0, "3/4", (24, 15)),
        (None, 32, 270, "1/2", (12, 16)),
        (1, 1, 0, "1/4", (1, 1)),
    ],
)
def test_what_is_sent_has_the_wanted_size(
    width: int | None, height: int | None, turn: int, part: str, size: tuple[int, int]
) -> None:
    picture = Shape(width, height, turn).picture(frame("mjpeg"), Fraction(part))
    assert (picture.shape[1], picture.shape[0]) == size


def test_a_frame_without_a_size_is_refused() -> None:
    empty = Frame(FrameInfo(format="bgr24", width=0, height=48), np.zeros(0, np.uint8), shared=False)
    with pytest.raises(PayloadError, match="a picture of 0x48 pixels"):
        Shape(None, None, 0).picture(empty)


class Doubtful(Frame):
    """A view whose memory was given to another frame while it was looked at."""

    def valid(self) -> bool:
        return False


class Feed(Queue[Frame]):
    """Stands in for the reader of the camera's frames: it has those that a test puts into it."""

    def __enter__(self) -> Feed:
        return self

    def __exit__(self, *_: object) -> None: ...

    def read(self, timeout: float) -> Frame | None:
        try:
            return self.get(timeout=timeout)
        except Empty:
            return None


class Bench:
    """The service in this process, between two networks in memory."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
        self.local, self.remote, self.feed = MemoryHub(), MemoryHub(), Feed()
        monkeypatch.setattr(module, "remote_transport", lambda _config, name: MemoryTransport(name, self.remote))
        monkeypatch.setattr(module, "FrameReader", lambda *_, **__: self.feed)
        config = parse({"robot": {"id": ROBOT}}, folder=folder, env={})
        self.operator = Listener(MemoryTransport("operator", self.remote))
        self.robot = Listener(MemoryTransport("client", self.local))
        self.service = CameraPublisher(config, MemoryTransport("robot", self.local))
        self._running = Running(self.service)
        self._captured = 0

    @property
    def pictures(self) -> list[bytes]:
        return [message.payload for message in self.operator.on("front-camera")]

    def show(self, kind: type[Frame] = Frame, form: str = "bgr24", data: Any = None) -> None:
        """A frame, long after the one before it; returns once it has been dealt with."""
        self._captured += 1
        times = {"captured_ns": self._captured * 1_000_000_000, "captured_ms": self._captured}
        before = self._dealt_with()
        info = FrameInfo(format=form, width=64, height=48, **times)
        self.feed.put(kind(info, frame().data if data is None else data, shared=False))
        assert until(lambda: self._dealt_with() > before)

    def _dealt_with(self) -> int:
        return sum(self.service.counters[what] for what in ("sent", "overwritten", "failed", "refused"))

    def close(self) -> None:
        self._running.stop()
        self.operator.transport.close()
        self.robot.transport.close()


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Bench]:
    bench = Bench(monkeypatch, tmp_path)
    yield bench
    bench.close()
    assert "pebble-camera" not in [thread.name for thread in threading.enumerate()]


@pytest.mark.parametrize(
    ("kind", "form", "data", "counter"),
    [(Doubtful, "bgr24", None, "overwritten"), (Frame, "mjpeg", np.zeros(100, np.uint8), "failed")],
)
def test_after_a_bad_frame_comes_a_full_picture(
    bench: Bench, kind: type[Frame], form: str, data: Any, counter: str
) -> None:
    decoder = VideoDecoder()
    for _ in range(2):
        bench.show()
    bench.show(kind, form, data)
    assert bench.service.counters[counter] == 1
    for _ in range(2):
        bench.show()
    assert until(lambda: len(bench.pictures) == 4)
    pictures = [decoder.feed(payload) for payload in bench.pictures]
    assert [picture is not None and picture.captured_ms for picture in pictures] == [1, 2, 4, 5]
    assert [picture is not None and picture.keyframe for picture in pictures][2]


@pytest.mark.parametrize(("level", "black"), [(12, True), (60, False)])
def test_pictures_that_are_only_black_are_a_problem(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, level: int, black: bool
) -> None:
    monkeypatch.setattr("pebble.runtime.source_check.REPEATS_S", 0.01)
    for _ in range(3):
        bench.show(data=np.full(48 * 64 * 3, level, np.uint8))
        time.sleep(0.01)
    report = "media-report/camera_publisher"
    assert until(lambda: "json 64x48" in bench.robot.newest(report).get("doing", ""))
    assert bench.robot.newest(report).get("problem") == ("shows only black since 0 s" if black else None)


def test_without_h264_there_is_a_problem_and_json_is_sent(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    def without_av(name: str, **options: Any) -> Any:
        if name == "h264":
            raise PebbleError("h264 needs PyAV")
        return make_encoder(name, **options)

    monkeypatch.setattr(module, "make_encoder", without_av)
    bench.show()  # it runs
    bench.robot.command("front-camera", {"enabled": True, "encoding": "h264"})
    assert bench.robot.became("media-report/camera_publisher", last_error="h264 needs PyAV", encoding="json")
    bench.show()
    assert until(lambda: len(bench.pictures) == 2)
    assert bench.pictures[-1].startswith(b"{")


def test_headers_count_as_bytes_under_way() -> None:
    """Else a long way would seem slow: of several frames under way the oldest would be taken for unconfirmed."""
    topic, payload = f"{BASE}/outgoing/front-camera", bytes(5000)
    written = len(payload) + len(topic) + 5  # by MQTT
    assert written <= wire_size(topic, payload) <= written + 100


# -- as its own process, with real brokers and an operator who decodes


class Camera(Device):
    """Writes the scene 15 times a second."""

    def __init__(self, folder: Path) -> None:
        self.numbers: dict[int, int] = {}  # of frames, by when they were captured (epoch milliseconds)
        self._scene, self._out = Scene(320, 240), np.zeros((240, 320, 3), np.uint8)
        super().__init__(folder, "camera", 15, self._out.size)

    def write(self, number: int) -> None:
        self._scene.render(number, self._out)
        stamp = time.time_ns() // 1_000_000
        self.numbers[stamp] = number
        form = {"format": "bgr24", "width": 320, "height": 240}
        self.writer.write(self._out, FrameInfo(captured_ns=time.monotonic_ns(), captured_ms=stamp, **form))


def publisher(local: Broker, remote: Broker, **video: Any) -> MediaProgram:
    names = ("camera_publisher", "video_publisher", "front-camera")
    return MediaProgram(*names, local.port, remote.port, **video)


@pytest.fixture
def viewer(remote: Broker) -> Iterator[Operator]:
    viewer = Operator(remote.port, "front-camera", VideoDecoder())
    yield viewer
    viewer.transport.close()


def rate_of(pictures: list[Decoded]) -> float:
    """Pictures per second, by when they were captured."""
    return 1000 * (len(pictures) - 1) / (pictures[-1].captured_ms - pictures[0].captured_ms)


def test_every_form_in_turn_at_the_wanted_rate(local: Broker, remote: Broker, viewer: Operator) -> None:
    with publisher(local, remote, publish_fps=10) as robot, Camera(robot.run_dir) as camera:
        first = viewer.wait(1)[0]
        assert (first.encoding, first.keyframe, first.picture.shape) == ("json", True, (240, 320, 3))
        viewer.wait(21)  # and more of them while the machine has too much to do to keep a camera's beat
        assert until(lambda: rate_of(viewer.received[-21:]) == pytest.approx(10, rel=0.05), 60)
        for encoding in ("pbvd", "h264"):
            robot.ask(encoding=encoding)
            viewer.wait_for(encoding)
            assert {picture.encoding for picture in viewer.wait(10)} == {encoding}
            assert robot.reported(encoding=encoding, width=320, height=240, running=True)
        robot.ask(encoding="smoke signals")
        viewer.wait_for("json")
        assert until(lambda: robot.reports[-1].rate == pytest.approx(10, abs=0.7), 60)
        # A machine that has too much to do makes pictures smaller, until their number cannot be read.
        whole = [one for one in viewer.received if one.picture.shape == (240, 320, 3)]
        assert whole
        assert all(read_counter(one.picture) == camera.numbers[one.captured_ms] for one in whole)
        assert viewer.decoder.problem == ""


def test_it_rests_while_the_remote_side_is_away_and_reports_a_camera_that_gives_nothing(
    local: Broker, remote: Broker, viewer: Operator
) -> None:
    def complains() -> bool:
        return bool(robot.reports) and "no frame from the camera" in (robot.reports[-1].last_error or "")

    with publisher(local, remote) as robot:
        assert until(complains)
        assert robot.reports[-1].doing == "waits for the camera"
        with Camera(robot.run_dir) as camera:
            viewer.wait(10)
            assert camera.writer.wanted
            remote.kill()
            assert robot.reported(running=False, doing="rests: the remote side is away")
            assert until(lambda: robot.reports[-1].last_error)
            assert until(lambda: not camera.writer.wanted)
            before = len(viewer.received)
            remote.start()
            assert until(lambda: len(viewer.received) > before + 5)
            assert viewer.received[before].keyframe
            assert robot.reported(running=True, last_error=None)
        assert until(complains)
