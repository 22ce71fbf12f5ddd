"""av_daemon as a real process, on robots of either transport: frames, what it says of them, and how it ends."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from pebble.config import Config, load
from pebble.contract import MEDIA_REPORT, MEDIA_STATUS
from pebble.contract.payloads import MediaReport
from pebble.media.scene import read_counter
from pebble.runtime.connections import hub_settings, local_transport
from pebble.transports import Message, QoS
from pebble.transports.frames import FrameReader
from tests.fakes.installed import Installed
from tests.services.av_daemon.av_rig import is_speech
from tests.support import ROOT, Broker, Child, until

SYNTHETIC = {"video": {"backend": "synthetic", "fps": 30}, "audio": {"source": "synthetic"}}
DEAF = {"video": {"backend": "libcamera", "fps": 30}, "audio": {"enabled": False}}
BLIND = {"video": {"enabled": False}, "audio": {"source": "synthetic"}}


class Robot:
    """A fabric, and on it av_daemon and somebody who listens."""

    def __init__(self, folder: Path, kind: str, section: dict[str, Any]) -> None:
        self._folder = folder
        self._local_transport: list[Any] = []
        raw: dict[str, Any] = {
            "robot": {"id": "rover"},
            "transport": {"kind": kind, "run_dir": str(folder / "run")},
            "services": {"av_daemon": {"enabled": True, "restart_delay_seconds": 0.1, **section}},
        }
        if kind == "mqtt":
            self._broker = Broker(folder)
            raw["local_mqtt"] = {"host": "127.0.0.1", "port": self._broker.port}
        (folder / "robot.json").write_text(json.dumps(raw))
        self.config: Config = load(folder / "robot.json")
        if kind == "zenoh":
            self._start(
                "hub", "pebble.runtime.hub", msgspec.json.encode(hub_settings(self.config), enc_hook=str).decode()
            )
        self.daemon = self._start("daemon", "pebble.services.av_daemon", str(folder / "robot.json"))
        self.statuses: list[dict[str, Any]] = []
        self.listener = local_transport(self.config, "listener").open(10)
        self.listener.subscribe(MEDIA_STATUS.topic(self.config.base), self._on_status)

    @property
    def run_dir(self) -> Path:
        return self.config.run_dir()

    @property
    def status(self) -> dict[str, Any]:
        """What it said last."""
        return self.statuses[-1] if self.statuses else {}

    def report(self, program: str, report: MediaReport) -> None:
        topic = MEDIA_REPORT.topic(self.config.base, program=program)
        self.listener.publish(topic, msgspec.json.encode(report))

    def log(self) -> str:
        return (self._folder / "daemon.log").read_text()

    def close(self) -> None:
        self.listener.close()
        for process in reversed(self._local_transport):
            process.terminate()
            process.wait(10)
        if hasattr(self, "_broker"):
            self._broker.stop()

    def _start(self, name: str, module: str, argument: str) -> subprocess.Popen[bytes]:
        with (self._folder / f"{name}.log").open("ab") as log:
            process = Child([sys.executable, "-m", module, argument], cwd=ROOT, stderr=log)
        self._local_transport.append(process)
        return process

    def _on_status(self, message: Message) -> None:
        self.statuses.append(json.loads(message.payload)["value"])


@pytest.fixture
def robot(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Robot]:
    """A robot of its own; its section is the parameter, if there is one."""
    robot = Robot(tmp_path, "mqtt", getattr(request, "param", SYNTHETIC))
    yield robot
    robot.close()


@pytest.fixture(scope="module", params=["mqtt", "zenoh"])
def running(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Robot]:
    """One robot of each kind, for tests that leave it as it was."""
    robot = Robot(tmp_path_factory.mktemp(request.param), request.param, SYNTHETIC)
    yield robot
    robot.close()


def test_pictures_arrive_and_their_counter_keeps_the_rate(running: Robot) -> None:
    with FrameReader(running.run_dir, "camera", depth=3) as reader:
        frames = [reader.read(10) for _ in range(40)]
    numbers = [read_counter(frame.picture()) for frame in frames if frame is not None]
    assert len(numbers) == 40
    assert None not in numbers
    starts = [frame.info.captured_ns / 1e9 - number / 30 for frame, number in zip(frames, numbers, strict=True)]
    assert min(starts[:20]) == pytest.approx(min(starts[20:]), abs=0.1)  # a busy machine is late now and then
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
        assert until(lambda: running.status.get("camera", {}).get("readers") == 2)
        assert until(lambda: running.status["camera"].get("rate", 0) > 25)
        camera = running.status["camera"]
        assert (camera["running"], camera["width"], camera["height"]) == (True, 640, 480)
    assert until(lambda: running.status["camera"]["readers"] == 0)


def test_it_publishes_the_status_of_other_programs(running: Robot) -> None:
    running.report("camera_publisher", MediaReport(running=True, encoding="h264", bitrate=212_000))
    running.report("camera", MediaReport(running=True, doing="is not what it says"))
    running.listener.publish(MEDIA_REPORT.topic(running.config.base, program="x"), b'{"running": NaN}')
    assert until(lambda: "camera_publisher" in running.status)
    assert running.status["camera_publisher"] == {"running": True, "encoding": "h264", "bitrate": 212_000}
    assert running.status["camera"].get("doing") != "is not what it says"
    assert "x" not in running.status


def test_a_report_of_no_program_ends_nothing(running: Robot) -> None:
    assert until(lambda: running.status)
    nameless = MEDIA_REPORT.topic(running.config.base, program="")
    running.listener.publish(nameless, b'{"running": true}', qos=QoS.DELIVERED, retain=True)
    running.report("after", MediaReport(running=True))
    assert until(lambda: "after" in running.status)
    assert running.daemon.poll() is None
    assert "" not in running.status
    running.listener.publish(nameless, b"", qos=QoS.DELIVERED, retain=True)


def test_a_late_subscriber_receives_the_status(running: Robot) -> None:
    assert until(lambda: running.status)
    late: list[bytes] = []
    other = local_transport(running.config, "late").open(10)
    other.subscribe(MEDIA_STATUS.topic(running.config.base), lambda message: late.append(message.payload))
    assert until(lambda: late)
    other.close()


def test_numbers_alone_are_published_rarely_and_everything_else_soon(robot: Robot) -> None:
    def sent(kbits: int, **more: Any) -> None:
        doing = f"h264 640x480, {kbits} kbit/s"
        trouble = f"no picture for {kbits} s"
        robot.report("other", MediaReport(running=True, doing=doing, bitrate=1000 * kbits, last_error=trouble, **more))

    assert until(lambda: robot.status)
    sent(200)
    assert until(lambda: "other" in robot.status)
    before = len(robot.statuses)
    for kbits in range(201, 211):
        sent(kbits)
        time.sleep(0.3)
    assert len(robot.statuses) - before <= 1
    sent(100, reduced="size 1/2")
    assert until(lambda: robot.status.get("other", {}).get("reduced") == "size 1/2", 3)


def test_devices_rest_and_silent_programs_are_forgotten(robot: Robot) -> None:
    assert until(lambda: robot.status.get("camera", {}).get("doing") == "rests: nobody reads")
    with FrameReader(robot.run_dir, "camera") as reader:
        assert reader.read(10) is not None
        robot.report("camera_publisher", MediaReport(running=True))
        assert until(lambda: robot.status["camera"]["running"] and "camera_publisher" in robot.status)
        assert robot.status["microphone"]["running"] is False
    assert until(lambda: list(robot.status) == ["camera", "microphone"], 15)
    assert until(lambda: robot.status["camera"]["running"] is False, 15)


def test_it_ends_at_once_and_publishes_it(robot: Robot) -> None:
    with FrameReader(robot.run_dir, "camera") as reader:
        assert reader.read(10) is not None
        assert until(lambda: robot.status.get("camera", {}).get("running"))
        robot.daemon.send_signal(signal.SIGTERM)
        assert robot.daemon.wait(10) == 0
    assert until(lambda: robot.status["camera"] == {"running": False, "doing": "ended"})


@pytest.mark.parametrize("robot", [BLIND], indirect=True)
def test_what_is_switched_off_is_not_there(robot: Robot) -> None:
    assert until(lambda: robot.status)
    assert list(robot.status) == ["microphone"]


@pytest.fixture
def rpicam(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Installed:
    return Installed(monkeypatch, tmp_path, "rpicam-vid", "tests.fakes.fake_rpicam")


@pytest.mark.parametrize("robot", [DEAF], indirect=True)
class TestWithCaptureProgram:
    def test_a_killed_one_is_back_and_the_reader_never_noticed(self, rpicam: Installed, robot: Robot) -> None:
        with FrameReader(robot.run_dir, "camera") as reader:
            first = reader.read(10)
            os.kill(rpicam.pids[-1], signal.SIGKILL)
            assert until(lambda: len(rpicam.pids) == 2)
            later = [reader.read(10) for _ in range(10)][-1]
            assert later.info.writer == first.info.writer
            assert read_counter(later.picture()) is not None
            assert until(lambda: robot.status["camera"].get("restarts") == 1)
            assert "signal 9" in robot.status["camera"]["last_error"]

    def test_it_does_not_outlive_a_killed_daemon(self, rpicam: Installed, robot: Robot) -> None:
        with FrameReader(robot.run_dir, "camera") as reader:
            assert reader.read(10) is not None
        robot.daemon.kill()
        robot.daemon.wait(10)
        assert rpicam.gone(rpicam.pids[-1])

    def test_it_is_missing(self, robot: Robot) -> None:
        """Without the fake: the status says what to install, and the daemon lives on."""
        with FrameReader(robot.run_dir, "camera"):
            assert until(lambda: "rpicam-apps" in robot.status.get("camera", {}).get("last_error", ""))
        assert robot.daemon.poll() is None
