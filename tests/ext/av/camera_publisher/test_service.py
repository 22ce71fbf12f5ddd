"""The camera publisher as its own process: a real writer of frames, real brokers, and an operator who decodes."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.ext.av.camera_publisher.camera_rig import Camera, Publisher, Seen, Viewer
from tests.support import Broker, until


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
    with Publisher("mqtt", local.port, remote.port, publish_fps=10) as robot, Camera(robot.run_dir, 15) as camera:
        first = viewer.wait(1)[0]
        assert (first.encoding, first.keyframe, first.shape) == ("json", True, (240, 320, 3))
        viewer.wait(61)  # and more of them while the machine has too much to do to keep a camera's beat
        assert until(lambda: rate_of(viewer.received[-61:]) == pytest.approx(10, rel=0.02), 60), rate_of(
            viewer.received[-61:]
        )
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


def test_nothing_is_encoded_while_the_remote_side_is_away(local: Broker, remote: Broker, viewer: Viewer) -> None:
    with Publisher("mqtt", local.port, remote.port) as robot, Camera(robot.run_dir, 15) as camera:
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


def test_a_camera_that_gives_nothing_is_reported(local: Broker, remote: Broker, viewer: Viewer) -> None:
    def complains() -> bool:
        return bool(robot.reports) and "no frame from the camera" in (robot.reports[-1].last_error or "")

    with Publisher("mqtt", local.port, remote.port) as robot:
        assert until(complains, 15)
        assert robot.reports[-1].doing == "waits for the camera"
        for _ in range(2):  # the second after a restart of the camera's program
            with Camera(robot.run_dir, 15):
                viewer.wait(5)
        assert until(complains, 15)
