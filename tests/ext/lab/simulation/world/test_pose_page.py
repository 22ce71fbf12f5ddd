"""Poses in a file in memory: never torn, never waited for, and at most one writer; and those between samples."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from pebble.errors import DeviceError
from pebble.extensions.lab.simulation.world.pose_page import PosePage, PoseReader
from pebble.extensions.lab.simulation.world.poses import RobotPose, Sample, Track
from tests.support import WAIT_S, Child, until

BUSY = """
import sys
from pathlib import Path
from pebble.extensions.lab.simulation.world.pose_page import PosePage
from pebble.extensions.lab.simulation.world.poses import RobotPose
page = PosePage(Path(sys.argv[1]), ["goob", "fred"])
ns = 0
while True:
    ns += 1
    page.write(ns, [RobotPose(ns, -ns, 3 * ns), RobotPose(5 * ns, ns, -ns)])
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "pages" / "page"


@pytest.fixture
def busy_writer(path: Path) -> Iterator[Child]:
    """A process that writes as fast as it can, until it is killed; sample ``ns`` can be checked."""
    with Child([sys.executable, "-c", BUSY, str(path)]) as child:
        try:
            assert until(lambda: path.exists() and len(PoseReader(path).tracks()) == 2, 60)
            yield child
        finally:
            child.kill()


def test_no_sample_is_torn_under_a_busy_writer_and_a_killed_one_is_replaced(busy_writer: Child, path: Path) -> None:
    reader, newest = PoseReader(path), 0
    for _ in range(500):
        tracks = reader.tracks()
        for name, (a, b, c) in (("goob", (1, -1, 3)), ("fred", (5, 1, -1))):
            assert all(pose == (a * ns, b * ns, c * ns) for ns, pose in tracks[name].samples)
        assert tracks["goob"].newest.ns >= newest
        newest = tracks["goob"].newest.ns
    busy_writer.kill()
    busy_writer.wait(WAIT_S)
    page = PosePage(path, ["goob"])
    assert reader.tracks() == {}, "its world was started again"
    assert PoseReader(path).tracks() == {}, "nothing of the killed program is left"
    page.close()


def test_a_world_has_one_program_whose_end_a_reader_notices(path: Path) -> None:
    page = PosePage(path, ["goob"])
    with pytest.raises(DeviceError, match="this world runs already"):
        PosePage(path, ["goob"])
    page.write(1, [RobotPose(0, 0, 0)])
    reader = PoseReader(path)
    assert list(reader.tracks()) == ["goob"]
    page.close()
    assert reader.tracks() == {}
    with pytest.raises(FileNotFoundError):
        PoseReader(path)


def test_what_is_no_page_and_a_folder_that_others_may_write_are_refused(path: Path) -> None:
    path.parent.mkdir(mode=0o700)
    path.write_bytes(b"x" * 1000)
    with pytest.raises(msgspec.DecodeError):
        PoseReader(path)
    path.parent.chmod(0o777)
    with pytest.raises(DeviceError, match="is not a folder that only you may write"):
        PosePage(path, ["goob"])


TRACK = Track([Sample(100, RobotPose(0, 0, 3.0)), Sample(200, RobotPose(1, -2, -3.0)), Sample(300, RobotPose(1, 0, 0))])


def test_a_pose_between_two_samples_is_interpolated_the_short_way_round() -> None:
    x, y, heading = TRACK.at(150)
    assert (x, y) == (0.5, -1.0)
    assert math.remainder(heading - math.pi, math.tau) == pytest.approx(0.0)


@pytest.mark.parametrize(("ns", "pose"), [(0, (0, 0, 3.0)), (200, (1, -2, -3.0)), (999, (1, 0, 0))])
def test_at_and_beyond_the_samples_a_pose_is_a_samples(ns: int, pose: tuple[float, float, float]) -> None:
    assert tuple(TRACK.at(ns)) == pytest.approx(pose)
