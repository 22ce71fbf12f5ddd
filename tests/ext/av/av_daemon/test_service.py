"""A stream, and av_daemon, keep their promises whatever a device does: fails, hangs, is killed, or is not wanted."""

from __future__ import annotations

import logging
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from pebble.contract import MEDIA_REPORT
from pebble.contract.payloads import MediaReport
from pebble.errors import DeviceError
from pebble.extensions.media.frames import FrameInfo, FrameReader
from pebble.extensions.media.frames.frame import picture
from pebble.extensions.media.speech import PERIOD_S, Speech
from pebble.services.av_daemon import health, sources
from pebble.services.av_daemon.health import NOTHING, Asked, Health
from pebble.services.av_daemon.service import Reports
from pebble.services.av_daemon.source import Capture, Source
from pebble.services.av_daemon.stream import Stream
from pebble.transports import QoS
from tests.ext.av.media_rig import Remembering, options
from tests.fakes.installed import Installed
from tests.kit.robot import ProgramRobot
from tests.kit.scene import read_counter
from tests.kit.sound import best_match
from tests.support import WAIT_S, Broker, quickly, until

PICTURE, SOUND = FrameInfo(format="mjpeg", width=640, height=480), FrameInfo(format="s16le", rate=16_000, channels=1)


class Streams:
    """Makes streams, looks after them as the service would, and ends them."""

    def __init__(self) -> None:
        self._all: list[Stream] = []
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._poll)
        self._thread.start()

    def __call__(
        self, writer: Remembering, open_source: Callable[[], Source], *, delay: float = 0.05, rest_s: float = 0.2,
        asked: Asked | None = None,
    ) -> Stream:  # fmt: skip
        stream = Stream("camera", writer, open_source, first_delay_s=delay, rest_s=rest_s, asked=asked)
        self._all.append(stream)
        return stream

    def close(self) -> None:
        self._done.set()
        self._thread.join()
        for stream in self._all:
            stream.end()
        for stream in self._all:
            stream.join(WAIT_S)

    def _poll(self) -> None:
        while not self._done.wait(0.05):
            for stream in list(self._all):
                stream.poll(time.monotonic())


@pytest.fixture
def streams() -> Iterator[Streams]:
    streams = Streams()
    yield streams
    streams.close()


class Device:
    """A camera as bad as a test wants it. ``openings`` and ``closings`` count."""

    def __init__(self, *, refuses: int = 0, frames: int = 1_000_000, error: Exception | None = None) -> None:
        self.openings = self.closings = self.interruptions = 0
        self.hangs = threading.Event()
        self.woken = threading.Event()
        self._refuses, self._frames, self._left = refuses, frames, 0
        self._error = error or DeviceError("unplugged")

    def __call__(self) -> Device:
        self.openings += 1
        if self.openings <= self._refuses:
            raise DeviceError("not there")
        self._left = self._frames
        return self

    def grab(self) -> Capture:
        time.sleep(0.005)
        if self.hangs.is_set():
            self.woken.wait()
        if self._left == 0:
            raise self._error
        self._left -= 1
        return Capture(FrameInfo(format="bgr24", width=1, height=1, stride=3), 3, b"abc")

    def close(self) -> None:
        self.closings += 1

    def interrupt(self) -> None:
        self.interruptions += 1


def report(stream: Stream) -> MediaReport:
    return stream.report(time.monotonic())


def rests(stream: Stream) -> bool:
    return until(lambda: report(stream).doing == "rests: nobody reads")


# -- while there is a reader


def test_a_device_is_open_only_while_it_has_readers(streams: Streams) -> None:
    writer, device = Remembering(wanted=False), Device()
    stream = streams(writer, device)
    assert rests(stream)
    assert (device.openings, report(stream).running, report(stream).readers) == (0, False, 0)
    writer.wanted = True
    assert until(lambda: report(stream).running)
    assert report(stream).readers == 1
    writer.wanted = False
    assert until(lambda: device.closings == 1)
    assert rests(stream)
    writer.wanted = True
    assert until(lambda: device.openings == 2)
    assert report(stream).restarts == 0
    assert report(stream).last_error is None


def test_who_comes_back_soon_finds_the_device_open(streams: Streams) -> None:
    writer, device = Remembering(), Device()
    streams(writer, device, rest_s=30)
    assert until(lambda: writer.frames)
    writer.wanted = False
    time.sleep(0.1)  # long enough to be noticed, had it mattered
    before = len(writer.frames)
    writer.wanted = True
    assert until(lambda: len(writer.frames) > before)
    assert (device.openings, device.closings) == (1, 0)


@pytest.mark.parametrize("born", [True, False])
def test_frames_are_born_in_the_segment_where_that_is_possible_and_stamped(streams: Streams, born: bool) -> None:
    writer, video = Remembering(born=born), {"width": 320, "height": 240, "fps": 30, "backend": "synthetic"}
    stream = streams(writer, sources.camera(options(video=video), time.monotonic()))
    assert until(lambda: len(writer.frames) >= 5)
    numbers = [read_counter(picture(data, info)) for info, data in writer.frames[:5]]
    assert None not in numbers
    assert numbers == sorted(set(numbers))
    assert (writer.counters["born"] >= 5) is born
    assert (report(stream).encoding, report(stream).width, report(stream).height) == ("bgr24", 320, 240)
    behind_s = (time.monotonic_ns() - writer.frames[-1][0].captured_ns) / 1e9
    assert 0 <= behind_s < 5, "stamped when it was complete"
    assert abs(time.time() - behind_s - writer.frames[-1][0].captured_ms / 1e3) < 5


# -- when the device fails


def test_a_device_that_is_not_there_is_tried_again_ever_more_slowly(
    streams: Streams, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    writer, device = Remembering(), Device(refuses=3)
    stream = streams(writer, device)
    assert until(lambda: report(stream).last_error == "not there")
    assert until(lambda: report(stream).running)
    assert device.openings == 4
    assert report(stream).restarts == 3
    assert "not there; it is opened again in 0.2 s" in caplog.text, "the third time"
    assert "as it should be again" not in caplog.text, "its frames had no problem"


@pytest.mark.parametrize("error", [DeviceError("unplugged"), ValueError("of a library")])
def test_a_device_that_fails_is_opened_again(streams: Streams, error: Exception) -> None:
    writer, device = Remembering(), Device(frames=3, error=error)
    stream = streams(writer, device, delay=0.01)
    assert until(lambda: device.openings >= 3)
    assert device.closings >= 2
    assert str(error) in (report(stream).last_error or "")
    assert len(writer.frames) >= 6


# -- when it hangs


def test_a_hung_device_is_replaced_and_does_no_harm_when_it_wakes(
    streams: Streams, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(health, "_SILENCE_S", 0.3)
    writer, hung, healthy = Remembering(), Device(), Device()
    devices = iter([hung, healthy])
    stream = streams(writer, lambda: next(devices)())
    assert until(lambda: writer.frames)
    hung.hangs.set()
    assert until(lambda: healthy.openings == 1 and report(stream).running)
    assert report(stream).last_error == "the device does not answer"
    assert hung.interruptions == 1
    assert len(writer.threads) == 2
    writer.threads.clear()
    hung.woken.set()
    assert until(lambda: hung.closings == 1)
    assert until(lambda: writer.threads)
    assert len(writer.threads) == 1


def test_a_device_that_hangs_while_it_opens_is_given_up_but_only_four_times(
    streams: Streams, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Threads that hang do not become more and more."""
    monkeypatch.setattr(health, "_OPENING_S", 0.05)
    release, tries = threading.Event(), []

    def hang() -> Source:
        tries.append(1)
        release.wait()
        raise DeviceError("at last")

    stream = streams(Remembering(), hang, delay=0.01)
    assert until(lambda: len(tries) == 4)
    assert report(stream).last_error == "the device does not answer"
    time.sleep(0.5)  # ten times as long as a try may take
    assert len(tries) == 4
    release.set()
    assert until(lambda: len(tries) > 4)


def test_ending_does_not_wait_for_a_hung_device(streams: Streams) -> None:
    writer, device = Remembering(), Device()
    stream = streams(writer, device)
    assert until(lambda: writer.frames)
    device.hangs.set()
    time.sleep(0.02)  # for the next grab to begin
    with quickly():
        stream.end()
        stream.join(0.1)
    device.woken.set()


# -- what is told


class TestHealth:
    def test_a_good_run_makes_the_next_failure_the_first_again(self) -> None:
        device = Health(2.0)
        assert [device.failed("no") for _ in range(6)] == [2, 4, 8, 16, 30, 30]
        device.opening(100.0)
        device.frame(FrameInfo(format="mjpeg"), 101.0)
        assert device.failed("no") == 30
        device.opening(200.0)
        device.frame(FrameInfo(format="mjpeg"), 211.0)
        assert device.failed("no") == 2
        assert [Health(0.0).failed("no"), Health(60.0).failed("no")] == [0, 60], "none, or long, as configured"

    def test_silence_counts_only_while_a_sign_of_life_is_due(self) -> None:
        device = Health(2.0)
        assert not device.overdue(1e9)
        device.opening(100.0)
        assert [device.overdue(114.0), device.overdue(116.0)] == [False, True]
        device.frame(FrameInfo(format="mjpeg"), 120.0)
        assert [device.overdue(123.0), device.overdue(125.0)] == [False, True]
        device.idle()
        assert not device.overdue(1e9)

    @pytest.mark.parametrize(
        ("info", "asked", "hz", "content", "problem"),
        [
            (PICTURE, Asked(15, 640, 480), 15, None, None),
            (PICTURE, Asked(15, 640, 480), 14, 7, "shows the same picture since 11 s"),
            (PICTURE, Asked(15, 640, 480), 15, [1, 2, 3, 4], "shows the same pictures again and again since 11 s"),
            (PICTURE, None, 10, 7, None),
            (PICTURE, Asked(15, 480, 640), 15, None, "gives pictures of 640x480 where 480x640 were asked"),
            (PICTURE, Asked(15, 640, 480), 7, None, "gives 7.0 pictures a second where 15 were asked"),
            (PICTURE, Asked(), 99, None, None),
            (SOUND, Asked(50), 50, NOTHING, "gives only zeros, as one that is muted or unplugged, since 11 s"),
            (SOUND, Asked(50), 138, None, "gives 44160 samples a second where 16000 were asked"),
        ],
    )
    def test_frames_that_come_in_time_may_show_nothing(
        self, info: FrameInfo, asked: Asked | None, hz: int, content: int | str | list[int] | None, problem: str | None
    ) -> None:
        device = Health(2.0, asked)
        device.opening(100.0)
        for number in range(11 * hz + 2):
            new = content[number % len(content)] if isinstance(content, list) else content
            device.frame(info, 100 + number / hz, content=1000 + number if new is None else new)
        found = device.report(111.0)
        assert (found.problem, found.last_error, found.doing) == (problem, problem, "runs")
        device.failed("unplugged")
        assert device.report(111.0).problem is None


@pytest.mark.parametrize("frozen", [True, False])
def test_a_frozen_picture_is_noticed_although_its_header_changes(
    streams: Streams, monkeypatch: pytest.MonkeyPatch, frozen: bool
) -> None:
    monkeypatch.setattr("pebble.runtime.source_check.REPEATS_S", 0.2)
    device, pictures = Device(), list[bytes]()

    def grab() -> Capture:
        time.sleep(0.005)
        number = b"%08d" % len(pictures)
        picture = b"frozen" if frozen else number
        pictures.append(b"\xff\xd8\xff\xfe\0\x0a%b\xff\xda%b\xff\xd9" % (number, picture))
        data = np.frombuffer(pictures[-1], np.uint8)
        return Capture(FrameInfo(format="mjpeg"), data.size, data)

    monkeypatch.setattr(device, "grab", grab)
    stream = streams(Remembering(), device, asked=Asked())
    assert until(lambda: len(pictures) > 200)
    assert until(lambda: report(stream).problem) if frozen else not report(stream).problem


def test_silent_programs_are_forgotten_and_there_is_room_for_every_robot_and_no_more() -> None:
    reports, running = Reports(), MediaReport(running=True)
    reports.put("camera_publisher", running, 100.0)
    reports.put("audio_publisher", running, 103.0)
    assert list(reports.current(104.9)) == ["audio_publisher", "camera_publisher"]
    assert list(reports.current(105.1)) == ["audio_publisher"]
    assert reports.current(108.1) == {}
    for number in range(1000):
        reports.put(f"program-{number}", running, 200.0)
    reports.put("program-0", MediaReport(running=False), 201.0)
    assert len(reports.current(201.0)) == 32
    assert not reports.current(201.0)["program-0"].running


# -- av_daemon as a real process: frames, what it says of them, and how it ends


SYNTHETIC = {"video": {"backend": "synthetic", "fps": 30}, "audio": {"source": "synthetic"}}


class Robot(ProgramRobot):
    """A robot whose av_daemon runs."""

    def __init__(self, kind: str, port: int, section: dict[str, Any]) -> None:
        super().__init__(kind, port, {"av_daemon": {"enabled": True, "restart_delay_seconds": 0.1, **section}})
        self.run_dir = self.config.run_dir()
        self.daemon = self.run("pebble.services.av_daemon.service:AvDaemon")

    @property
    def status(self) -> dict[str, Any]:
        """What it said last."""
        status: dict[str, Any] = self.world.newest("media-status").get("value", {})
        return status

    def reported(self, device: str, timeout: float = WAIT_S, **fields: Any) -> bool:
        """Wait until the status of a device has these fields."""
        return until(lambda: fields.items() <= self.status.get(device, {}).items(), timeout)

    def report(self, program: str, report: MediaReport | bytes) -> None:
        raw = report if isinstance(report, bytes) else msgspec.json.encode(report)
        topic = MEDIA_REPORT.topic(self.config.base, program=program)
        self.world.transport.publish(topic, raw, qos=QoS.DELIVERED)


@pytest.fixture(scope="module")
def running(local: Broker) -> Iterator[Robot]:
    """Yield a robot for tests that leave it as it was."""
    with Robot("zenoh", local.port, SYNTHETIC) as robot:
        yield robot


def test_pictures_arrive_and_their_counter_keeps_the_rate(running: Robot) -> None:
    with FrameReader(running.run_dir, "camera", depth=3) as reader:
        frames = [reader.read(10) for _ in range(20)]
    numbers = [read_counter(frame.picture()) for frame in frames if frame is not None]
    assert len(numbers) == 20
    assert None not in numbers
    starts = [frame.info.captured_ns / 1e9 - number / 30 for frame, number in zip(frames, numbers, strict=True)]
    assert min(starts[:10]) == pytest.approx(min(starts[10:]), abs=0.1)  # a busy machine is late now and then
    assert frames[0].info.format == "bgr24"
    assert abs(frames[-1].info.captured_ms / 1e3 - time.time()) < 10


def test_sound_arrives_as_it_was_made(running: Robot) -> None:
    speech = Speech(16_000).samples(0, 2 * PERIOD_S * 16_000)[:, 0].astype(float)  # what comes is somewhere in it
    with FrameReader(running.run_dir, "microphone", depth=50) as reader:
        assert reader.read(10) is not None

        def comes() -> bool:
            chunks = [reader.read(10) for _ in range(50)]
            assert set(np.diff([chunk.info.sequence for chunk in chunks])) == {1}
            return best_match(np.concatenate([chunk.data.view(np.int16) for chunk in chunks]), speech) > 0.999

        assert until(comes), "a busy machine leaves pieces out"


def test_it_publishes_the_status_of_camera_and_microphone(running: Robot) -> None:
    with FrameReader(running.run_dir, "camera") as first, FrameReader(running.run_dir, "camera"):
        assert first.read(10) is not None
        assert running.reported("camera", readers=2, running=True, width=640, height=480)
        assert until(lambda: running.status["camera"].get("rate", 0) > 0)
    assert running.reported("camera", readers=0)


def test_it_publishes_the_status_of_other_programs(running: Robot) -> None:
    running.report("camera_publisher", MediaReport(running=True, encoding="h264", bitrate=212_000))
    running.report("camera", MediaReport(running=True, doing="is not what it says"))
    running.report("x", b'{"running": NaN}')
    assert until(lambda: "camera_publisher" in running.status)
    assert running.status["camera_publisher"] == {"running": True, "encoding": "h264", "bitrate": 212_000}
    assert running.status["camera"].get("doing") != "is not what it says"
    assert "x" not in running.status


def test_numbers_alone_are_published_rarely_and_everything_else_soon_also_its_end(local: Broker) -> None:
    def sent(kbits: int, **more: Any) -> None:
        doing = f"h264 640x480, {kbits} kbit/s"
        trouble = f"no picture for {kbits} s"
        robot.report("other", MediaReport(running=True, doing=doing, bitrate=1000 * kbits, last_error=trouble, **more))

    with Robot("mqtt", local.port, SYNTHETIC) as robot:
        assert until(lambda: robot.status)
        sent(200)
        assert until(lambda: "other" in robot.status)
        before = len(robot.world.on("media-status"))
        for kbits in range(201, 206):
            sent(kbits)
            time.sleep(0.3)
        assert len(robot.world.on("media-status")) - before <= 1
        sent(100, reduced="size 1/2")
        assert robot.reported("other", reduced="size 1/2")
        with FrameReader(robot.run_dir, "camera") as reader:
            assert reader.read(10) is not None
            assert robot.reported("camera", running=True)
            assert robot.daemon.end(signal.SIGTERM) == 0
        assert until(lambda: robot.status["camera"] == {"running": False, "doing": "ended"})


def test_a_killed_capture_program_is_back_and_the_reader_never_noticed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, local: Broker
) -> None:
    rpicam = Installed(monkeypatch, tmp_path, "rpicam-vid", "tests.fakes.fake_rpicam")
    section = {"video": {"backend": "libcamera", "fps": 30}, "audio": {"enabled": False}}
    with Robot("mqtt", local.port, section) as robot, FrameReader(robot.run_dir, "camera") as reader:
        first = reader.read(10)
        os.kill(rpicam.pids[-1], signal.SIGKILL)
        assert until(lambda: len(rpicam.pids) == 2)
        later = [reader.read(10) for _ in range(10)][-1]
        assert later.info.writer == first.info.writer
        assert read_counter(later.picture()) is not None
        assert robot.reported("camera", restarts=1)
        assert "signal 9" in robot.status["camera"]["last_error"]
