"""av_daemon as a real process: frames, what it says of them, and how it ends."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from pebble.contract import MEDIA_REPORT
from pebble.contract.payloads import MediaReport
from pebble.extensions.media.frames import FrameReader
from pebble.transports import QoS
from tests.ext.av.av_daemon.av_rig import is_speech
from tests.fakes.installed import Installed
from tests.kit.robot import ProgramRobot
from tests.kit.scene import read_counter
from tests.support import Broker, until

SYNTHETIC = {"video": {"backend": "synthetic", "fps": 30}, "audio": {"source": "synthetic"}}
DEAF = {"video": {"backend": "libcamera", "fps": 30}, "audio": {"enabled": False}}


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

    def reported(self, device: str, timeout: float = 10.0, **fields: Any) -> bool:
        """Wait until the status of a device has these fields."""
        return until(lambda: fields.items() <= self.status.get(device, {}).items(), timeout)

    def report(self, program: str, report: MediaReport | bytes) -> None:
        raw = report if isinstance(report, bytes) else msgspec.json.encode(report)
        topic = MEDIA_REPORT.topic(self.config.base, program=program)
        self.world.transport.publish(topic, raw, qos=QoS.DELIVERED)


@pytest.fixture(scope="module")
def running(local: Broker) -> Iterator[Robot]:
    """One robot for tests that leave it as it was."""
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
    with FrameReader(running.run_dir, "microphone", depth=50) as reader:
        assert reader.read(10) is not None
        chunks = [reader.read(10) for _ in range(50)]
    assert set(np.diff([chunk.info.sequence for chunk in chunks])) == {1}
    received = [(chunk.info.captured_ns, chunk.data.view(np.int16)) for chunk in chunks]
    assert sum(is_speech(received, start) for start in range(0, 160_000, 320)) == 1


def test_it_publishes_the_status_of_camera_and_microphone(running: Robot) -> None:
    with FrameReader(running.run_dir, "camera") as first, FrameReader(running.run_dir, "camera"):
        assert first.read(10) is not None
        assert running.reported("camera", readers=2, running=True, width=640, height=480)
        assert until(lambda: running.status["camera"].get("rate", 0) > 25)
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
        assert robot.reported("other", 3, reduced="size 1/2")
        with FrameReader(robot.run_dir, "camera") as reader:
            assert reader.read(10) is not None
            assert robot.reported("camera", running=True)
            assert robot.daemon.end(signal.SIGTERM) == 0
        assert until(lambda: robot.status["camera"] == {"running": False, "doing": "ended"})


def test_a_killed_capture_program_is_back_and_the_reader_never_noticed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, local: Broker
) -> None:
    rpicam = Installed(monkeypatch, tmp_path, "rpicam-vid", "tests.fakes.fake_rpicam")
    with Robot("mqtt", local.port, DEAF) as robot, FrameReader(robot.run_dir, "camera") as reader:
        first = reader.read(10)
        os.kill(rpicam.pids[-1], signal.SIGKILL)
        assert until(lambda: len(rpicam.pids) == 2)
        later = [reader.read(10) for _ in range(10)][-1]
        assert later.info.writer == first.info.writer
        assert read_counter(later.picture()) is not None
        assert robot.reported("camera", restarts=1)
        assert "signal 9" in robot.status["camera"]["last_error"]
