"""The camera of a robot in a simulated world, which may not run."""

from __future__ import annotations

import json
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from pebble.errors import DeviceError, NotRunningError
from pebble.extensions.lab.simulation.world.pose_page import PosePage, page_path
from pebble.extensions.lab.simulation.world.poses import RobotPose
from pebble.extensions.lab.simulation.world.world_file import read_world
from pebble.extensions.media.frames.frame import picture
from pebble.services.av_daemon import sources
from pebble.services.av_daemon.config import CameraCapture
from pebble.services.av_daemon.health import Health
from pebble.services.av_daemon.source import Source
from pebble.services.av_daemon.synthetic import WorldCamera
from tests.ext.av.av_daemon.av_rig import grabbed, options
from tests.ext.lab.simulation.world.worlds import CLEAR, projected, tags_in

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


def test_a_wrong_device_is_one_line(path: Path) -> None:
    wrong = CameraCapture(backend="synthetic", device=f"{path}#gob")
    with pytest.raises(DeviceError, match=rf"^{path}: there is no robot 'gob', did you mean \"goob\"\?$"):
        WorldCamera(wrong, 0.0)
