"""The camera publisher as its own process: a real writer of frames, real brokers, and an operator who decodes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pebble.extensions.media.decode import VideoDecoder
from pebble.extensions.media.frames import FrameInfo
from pebble.extensions.media.scene import Scene
from pebble.transports import Message
from tests.ext.av.media_rig import Device, MediaProgram, Operator
from tests.kit.scene import read_counter
from tests.support import Broker, until


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


@dataclass(frozen=True)
class Seen:
    """A picture at the operator."""

    captured_ms: int  # since the epoch
    number: int | None
    encoding: str
    keyframe: bool
    shape: tuple[int, ...]


class Viewer(Operator):
    """Decodes every picture, and reads its number."""

    def __init__(self, port: int) -> None:
        self.decoder = VideoDecoder()
        super().__init__(port, "front-camera")

    def receive(self, message: Message) -> None:
        one = self.decoder.feed(message.payload)
        if one is not None and one.captured_ms is not None:
            number, shape = read_counter(one.picture), one.picture.shape
            self.received.append(Seen(one.captured_ms, number, one.encoding, one.keyframe, shape))


def publisher(local: Broker, remote: Broker, **video: Any) -> MediaProgram:
    names = ("camera_publisher", "video_publisher", "front-camera")
    return MediaProgram(*names, local.port, remote.port, **video)


@pytest.fixture
def viewer(remote: Broker) -> Iterator[Viewer]:
    viewer = Viewer(remote.port)
    yield viewer
    viewer.close()


def rate_of(pictures: list[Seen]) -> float:
    """Pictures per second, by when they were captured."""
    return 1000 * (len(pictures) - 1) / (pictures[-1].captured_ms - pictures[0].captured_ms)


def are_what_was_captured(pictures: list[Seen], camera: Camera) -> bool:
    """Those of full size: a machine that has too much to do reduces them until their number cannot be read."""
    whole = [picture for picture in pictures if picture.shape == (240, 320, 3)]
    return bool(whole) and all(picture.number == camera.numbers[picture.captured_ms] for picture in whole)


def test_every_form_in_turn_at_the_wanted_rate(local: Broker, remote: Broker, viewer: Viewer) -> None:
    with publisher(local, remote, publish_fps=10) as robot, Camera(robot.run_dir) as camera:
        first = viewer.wait(1)[0]
        assert (first.encoding, first.keyframe, first.shape) == ("json", True, (240, 320, 3))
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
        assert are_what_was_captured(viewer.received, camera)
        assert viewer.decoder.problem == ""


def test_it_rests_while_the_remote_side_is_away_and_reports_a_camera_that_gives_nothing(
    local: Broker, remote: Broker, viewer: Viewer
) -> None:
    def complains() -> bool:
        return bool(robot.reports) and "no frame from the camera" in (robot.reports[-1].last_error or "")

    with publisher(local, remote) as robot:
        assert until(complains, 15)
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
            assert until(lambda: len(viewer.received) > before + 5, 20)
            assert viewer.received[before].keyframe
            assert robot.reported(running=True, last_error=None)
        assert until(complains, 15)
