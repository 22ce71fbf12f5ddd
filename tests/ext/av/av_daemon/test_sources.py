"""Every kind of camera and microphone, with programs that stand in for hardware that is not there."""

from __future__ import annotations

import json
import os
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pebble.errors import DeviceError, NotRunningError
from pebble.extensions.lab.simulation.world.pose_page import PosePage, page_path
from pebble.extensions.lab.simulation.world.poses import RobotPose
from pebble.extensions.lab.simulation.world.world_file import read_world
from pebble.extensions.media.child import Child
from pebble.extensions.media.frames import FrameInfo
from pebble.extensions.media.frames.frame import picture
from pebble.extensions.media.scene import Scene
from pebble.extensions.media.speech import Speech
from pebble.services.av_daemon import alsa, capture_program, libcamera, sources
from pebble.services.av_daemon.alsa import AlsaMicrophone
from pebble.services.av_daemon.capture_program import CaptureProgram
from pebble.services.av_daemon.health import Asked, Health, RateCheck
from pebble.services.av_daemon.jpeg_splitter import JpegSplitter
from pebble.services.av_daemon.libcamera import LibcameraCamera
from pebble.services.av_daemon.source import Capture, Source
from pebble.services.av_daemon.sources import Rotated
from pebble.services.av_daemon.synthetic import Pacer, SyntheticCamera, SyntheticMicrophone
from pebble.services.av_daemon.v4l2 import V4l2Camera
from tests.ext.av.media_rig import grabbed, options
from tests.ext.lab.simulation.world.worlds import CLEAR, projected, tags_in
from tests.fakes.installed import Installed
from tests.kit.scene import read_counter
from tests.support import gone, quickly, until

SMALL = {"width": 320, "height": 240, "fps": 30}


Open = Callable[..., Source]


@pytest.fixture
def opened() -> Iterator[list[Source]]:
    """Sources put in here are closed in the end."""
    sources: list[Source] = []
    yield sources
    for source in sources:
        source.close()


@pytest.fixture
def alsa_microphone(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, opened: list[Source]) -> Open:
    Installed(monkeypatch, tmp_path, "arecord", "tests.fakes.fake_arecord")

    def open_(fake: str = "", **audio: Any) -> Source:
        monkeypatch.setenv("FAKE", fake)
        opened.append(AlsaMicrophone(options(audio=audio)))
        return opened[-1]

    return open_


class TestLibcamera:
    def test_pictures_come_and_their_counter_advances(
        self,
        monkeypatch: pytest.MonkeyPatch,
        tmp_path: Path,
        opened: list[Source],
        caplog: pytest.LogCaptureFixture,
    ) -> None:
        """Also of the older program, and by another name of the backend."""
        Installed(monkeypatch, tmp_path, "libcamera-vid", "tests.fakes.fake_rpicam")
        video = {**SMALL, "backend": "picamera2", "capture_format": "yuyv"}
        camera = sources.camera(options(video=video), 0.0)()
        opened.append(camera)
        frames = [grabbed(camera) for _ in range(8)]
        numbers = [read_counter(picture(data, info)) for info, data in frames]
        assert None not in numbers
        assert numbers == sorted(set(numbers))
        info, data = frames[0]
        assert (info.width, info.height) == (320, 240)
        assert (data[:2].tobytes(), data[-2:].tobytes()) == (b"\xff\xd8", b"\xff\xd9")
        assert (info.format, info.stride) == ("mjpeg", 0), "its own JPEG is passed on as it is"
        assert "capture_format yuyv does nothing" in caplog.text
        pictures = TestJpegSplitter.PICTURES
        monkeypatch.setattr(LibcameraCamera, "read", lambda _self: b"".join(pictures))
        capture = camera.grab()
        assert (capture.data, capture.skipped) == (pictures[-1], 2)
        monkeypatch.setattr(libcamera, "SILENCE_S", 0.1)
        monkeypatch.setattr(LibcameraCamera, "read", lambda _self: time.sleep(0.01) or pictures[0][:-9])
        with pytest.raises(DeviceError, match="libcamera-vid writes no whole JPEG"):
            camera.grab()

    def test_a_wait_can_be_interrupted_and_leaves_no_thread(
        self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        rpicam = Installed(monkeypatch, tmp_path, "rpicam-vid", "tests.fakes.fake_rpicam")
        monkeypatch.setenv("FAKE", "quiet")
        camera = LibcameraCamera(options(video=SMALL))
        assert until(lambda: rpicam.pids)
        threading.Timer(0.1, camera.interrupt).start()
        with pytest.raises(DeviceError, match="signal 9"):
            camera.grab()
        camera.close()
        assert rpicam.gone(rpicam.pids[0])


@pytest.mark.parametrize(("opener", "fix"), [(LibcameraCamera, "rpicam-apps"), (AlsaMicrophone, "alsa-utils")])
def test_a_missing_program_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, opener: Callable[[Any], Source], fix: str
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(DeviceError, match=fix):
        opener(options(video=SMALL))


def test_silence_is_an_error(monkeypatch: pytest.MonkeyPatch, alsa_microphone: Open) -> None:
    monkeypatch.setattr(capture_program, "SILENCE_S", 1.0)
    device = alsa_microphone("hangs")
    for _ in range(50):
        device.grab()
    with pytest.raises(DeviceError, match="arecord hangs: nothing came for 1 s"):
        device.grab()


class TestCaptureProgram:
    def test_one_that_does_not_want_to_end_is_killed(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(capture_program, "_STOP_S", 0.2)
        program = CaptureProgram(["sh", "-c", "trap '' TERM; echo up; while :; do sleep 0.05; done"])
        assert program.read() == b"up\n"
        with quickly():
            program.close()

    def test_errors_fill_no_pipe(self) -> None:
        program = CaptureProgram(["sh", "-c", "yes 'a line of errors' | head -n 100000 >&2; echo done"])
        assert program.read() == b"done\n"
        with pytest.raises(DeviceError, match=r"exit code 0 \(a line of errors\)"):
            program.read()
        program.close()

    def test_what_a_program_leaves_behind_ends_with_it(self) -> None:
        program = Child(["sh", "-c", "sleep 60 & echo $!"], dict(os.environ), stdout=subprocess.PIPE)
        left = int(program.pipe("stdout").readline())
        assert program.wait() == 0
        assert until(lambda: gone(left))


class TestAlsa:
    def test_every_sample_arrives_in_order(self, alsa_microphone: Open, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(alsa, "_BEHIND", 1000)  # however busy this machine is
        form = {"rate": 44_100, "channels": 2}
        microphone = alsa_microphone(**form)
        frames = [grabbed(microphone) for _ in range(15)]
        received = np.concatenate([data for _, data in frames]).view(np.int16).reshape(-1, 2)
        assert np.array_equal(received, Speech(44_100, 2).samples(0, len(received)))
        info, data = frames[0]
        assert (info.format, info.rate, info.channels) == ("s16le", 44_100, 2)
        assert data.size == sources.chunk_bytes(options(audio=form)) == 882 * 4

    def test_after_a_delay_it_continues_with_the_present(
        self, alsa_microphone: Open, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        sound = Speech(16_000).samples(0, 320 * 15)[:, 0].tobytes()
        monkeypatch.setattr(alsa.AlsaMicrophone, "read", lambda _self: sound)
        capture = alsa_microphone().grab()
        assert (capture.data, capture.skipped) == (sound[-640:], 14)
        monkeypatch.setattr(alsa.AlsaMicrophone, "read", lambda _self: sound[: 640 * 5])
        at_ns = alsa_microphone().grab().at_ns
        assert 4 * 20_000_000 <= time.monotonic_ns() - at_ns < 5_000_000_000, "others came after it"


@pytest.fixture(scope="session")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten frames of the scene, 320x240."""
    file = tmp_path_factory.mktemp("film") / "scene.avi"
    writer = cv2.VideoWriter(str(file), cv2.CAP_OPENCV_MJPEG, cv2.VideoWriter.fourcc(*"MJPG"), 15, (320, 240))
    scene, out = Scene(320, 240), np.empty((240, 320, 3), np.uint8)
    for number in range(10):
        scene.render(number, out)
        writer.write(out)
    writer.release()
    return file


class TestOpenCv:
    def test_a_file_plays_a_camera_and_ends(self, film: Path, opened: list[Source]) -> None:
        opened.append(V4l2Camera(options(video={"device": str(film)}).video))
        frames = [grabbed(opened[0]) for _ in range(9)]  # the first was looked at when it was opened
        assert [read_counter(picture(data, info)) for info, data in frames] == list(range(1, 10))
        assert frames[0][0].format == "bgr24"
        assert (frames[0][0].width, frames[0][0].height, frames[0][0].stride) == (320, 240, 960)
        with pytest.raises(DeviceError, match="gives no picture"):
            opened[0].grab()

    def test_only_a_camera_of_this_machine_is_asked_for_a_rate_and_a_size(self) -> None:
        devices = ("0", "/dev/video2", "film.avi", "rtsp://127.0.0.1/door")
        asked = [sources.asked_of_camera(options(video={**SMALL, "device": device}).video) for device in devices]
        assert asked == [Asked(30, 320, 240), Asked(30, 320, 240), Asked(), Asked()]

    @pytest.mark.parametrize("device", ["99", "rtsp://someone:s3cret@127.0.0.1:1/door?key=s3cret"])
    def test_what_is_not_there_is_an_error_without_a_password(self, device: str) -> None:
        with pytest.raises(DeviceError, match="cannot open") as raised:
            V4l2Camera(options(video={"device": device}).video)
        assert ("rtsp://127.0.0.1:1/door" in str(raised.value)) is device.startswith("rtsp")
        assert "s3cret" not in str(raised.value)


class Still:
    """A camera that always sees the same."""

    def __init__(self, info: FrameInfo, data: bytes, *, broken: int = 0) -> None:
        self._info, self._data, self._broken = info, data, broken

    def grab(self) -> Capture:
        self._broken -= 1
        data = b"no picture" if self._broken >= 0 else self._data
        return Capture(self._info, len(data), data, at_ns=7)

    def close(self) -> None: ...

    def interrupt(self) -> None: ...


class TestRotation:
    @pytest.mark.parametrize("degrees", [0, 90, 180, 270])
    def test_of_the_configured_camera(self, degrees: int) -> None:
        """Turned back, its counter can be read."""
        chosen = options(video={**SMALL, "backend": "synthetic", "fps": 500, "rotate_degrees": degrees})
        info, data = grabbed(sources.camera(chosen, time.monotonic())())
        assert (info.width, info.height) == ((320, 240) if degrees % 180 == 0 else (240, 320))
        assert data.size == sources.picture_bytes(chosen)
        assert read_counter(np.rot90(picture(data, info), degrees // 90)) is not None

    def test_compressed_pictures_become_bgr(self) -> None:
        scene = np.empty((240, 320, 3), np.uint8)
        Scene(320, 240).render(77, scene)
        coded = cv2.imencode(".jpg", scene)[1].tobytes()
        camera = Rotated(Still(FrameInfo(format="mjpeg", width=320, height=240), coded, broken=3), 180)
        capture = camera.grab()
        turned = options(video={**SMALL, "backend": "libcamera", "rotate_degrees": 180})
        assert capture.size == sources.picture_bytes(turned)
        data = capture.pixels(np.empty(capture.size, np.uint8))
        assert (capture.info.format, capture.info.stride, capture.skipped) == ("bgr24", 960, 3)
        assert read_counter(np.rot90(picture(data, capture.info), 2)) == 77

    def test_nothing_but_broken_pictures_is_an_error(self) -> None:
        camera = Rotated(Still(FrameInfo(format="mjpeg", width=320, height=240), b"", broken=1000), 90)
        with pytest.raises(DeviceError, match="cannot be decoded"):
            camera.grab()


class TestSynthetic:
    @pytest.mark.parametrize("source", [SyntheticCamera(options(video={"fps": 0.01}).video, time.monotonic()),
                                        SyntheticMicrophone(options().audio, time.monotonic())])  # fmt: skip
    def test_nothing_comes_after_an_interruption(self, source: Source) -> None:
        threading.Timer(0.05, source.interrupt).start()
        with pytest.raises(DeviceError):
            list(iter(source.grab, None))

    def test_speech_was_recorded_when_its_time_says(self) -> None:
        capture = SyntheticMicrophone(options().audio, began := time.monotonic()).grab()
        turn = round((capture.at_ns / 1e9 - began) / alsa.CHUNK_S)  # the chunk is complete by then
        assert np.array_equal(capture.data, Speech(16_000).samples(320 * (turn - 1), 320))


class TestPacer:
    def paced(self, rate: float, *, behind: int = 0) -> tuple[Pacer, list[float]]:
        now = [1000.0]
        return Pacer(rate, behind=behind, start=1000.0, clock=lambda: now[0]), now

    def test_who_stood_still_goes_on_with_the_present_turn_or_with_what_may_be_made_up_for(self) -> None:
        pacer, now = self.paced(15)
        pacer.next()
        now[0] += 10
        assert (pacer.next(), pacer.skipped) == (150, 148)
        assert (pacer.next(), pacer.skipped) == (151, 0)
        pacer, now = self.paced(50, behind=10)
        pacer.next()
        now[0] += 0.2
        assert [pacer.next() for _ in range(3)] == [2, 3, 4]
        now[0] += 10
        assert pacer.next() == 510


class TestJpegSplitter:
    PICTURES = tuple(
        cv2.imencode(".jpg", np.full((16, 16, 3), shade, np.uint8))[1].tobytes() for shade in (0, 100, 200)
    )

    @pytest.mark.parametrize("size", [1, 7, 100_000])
    def test_pictures_come_out_as_they_went_in(self, size: int) -> None:
        stream, splitter = b"".join(self.PICTURES), JpegSplitter()
        got = [found for at in range(0, len(stream), size) for found in splitter.feed(stream[at : at + size])]
        assert got == list(self.PICTURES)

    def test_a_preview_inside_ends_no_picture_and_what_is_none_is_skipped(self) -> None:
        preview = b"\xff\xe1" + (len(self.PICTURES[0]) + 2).to_bytes(2) + self.PICTURES[0]
        whole = self.PICTURES[1][:2] + b"\xff\x01" + preview + self.PICTURES[1][2:]
        assert JpegSplitter().feed(whole + self.PICTURES[2]) == [whole, self.PICTURES[2]]
        splitter = JpegSplitter(limit=10_000)
        stream = b"garbage" + self.PICTURES[0] + b"\xff\xd8 no picture \xff" + self.PICTURES[1]
        assert splitter.feed(stream) == [self.PICTURES[0], self.PICTURES[1]]
        assert splitter.feed(self.PICTURES[0][:-2] + bytes(20_000)) == [], "it has no end"
        assert splitter.feed(self.PICTURES[1]) == [self.PICTURES[1]]


# -- the camera of a robot in a simulated world, which may not run


TAG = {"id": 13, "x": 2.0, "y": 0.0, "yaw_deg": 180}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    world = {"tags": [TAG], "robots": {"goob": {"x": 0, "y": 0}}, "camera": {"latency_ms": 100.0, **CLEAR}}
    (tmp_path / "world.json").write_text(json.dumps(world))
    return tmp_path / "world.json"


def stand(page: PosePage, x: float = 0.0, *, ago_s: float = 0.0) -> int:
    ns = time.monotonic_ns() - round(ago_s * 1e9)
    page.write(ns, [RobotPose(x, 0.0, 0.0)])
    return ns


def camera_of(path: Path) -> Source:
    """A device with a number sign is a robot in a world."""
    return sources.camera(options(video={"backend": "synthetic", "device": f"{path}#goob", "fps": 200}), 0.0)()


def test_latency_shows_an_earlier_pose_with_its_time_and_a_world_that_ends_is_not_running(path: Path) -> None:
    page = PosePage(page_path(path), ["goob"])
    ns = stand(page, 0.5)
    page.write(ns + 100_000_000, [RobotPose(1.5, 0.0, 0.0)])
    camera = camera_of(path)
    info, data = grabbed(camera)
    off = np.abs(tags_in(picture(data, info))[13] - projected(read_world(path), 13, (0.5, 0.0, 0.0))).max()
    assert off < 1.0, "the tag is where the robot sees it from there"
    assert camera.grab().at_ns == ns
    page.close()
    with pytest.raises(NotRunningError):
        camera.grab()


def test_the_error_without_a_world_names_the_command_that_starts_it(path: Path) -> None:
    absent = pytest.raises(NotRunningError, match=rf"^the world does not run, start it: pebble sim world {path}$")
    with absent:
        camera_of(path)
    with closing(PosePage(page_path(path), ["goob"])) as silent, absent:
        stand(silent, ago_s=1.5)
        camera_of(path)
    health = Health(2.0)
    assert [health.failed("absent", expected=True) for _ in range(4)] == [2.0] * 4, "it is looked for all the time"


@pytest.mark.parametrize(("hz", "asked", "found"), [(13, 15, None), (10, 15, 10), (19, 15, 19), (3, 0, None)])
def test_rates(hz: int, asked: float, found: float | None) -> None:
    check = RateCheck(asked)
    for number in range(2 * hz):
        check.count(1, 100 + number / hz / 10)  # a start in a hurry
    for number in range(13 * hz):
        check.count(1, 102 + number / hz)
    assert check.wrong_hz == (None if found is None else pytest.approx(found, rel=0.05))
