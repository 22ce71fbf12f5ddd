"""Poses in shared memory: never torn, never waited for, and at most one writer."""

from __future__ import annotations

import struct
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from pebble.errors import DeviceError
from pebble.extensions.lab.simulation.world import pose_page
from pebble.extensions.lab.simulation.world.pose_page import PosePage, PoseReader, page_path
from pebble.extensions.lab.simulation.world.poses import RobotPose
from tests.support import Child, until

BUSY = """
import sys, time
from pathlib import Path
from pebble.simulation.world.pose_page import PosePage
from pebble.simulation.world.poses import RobotPose
page = PosePage(Path(sys.argv[1]), ["goob", "fred"])
ns = 0
while True:
    ns += 1
    page.write(ns, [RobotPose(ns, -ns, 3 * ns), RobotPose(5 * ns, ns, -ns)])
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    (tmp_path / "pages").mkdir(mode=0o700)
    return tmp_path / "pages" / "page"


@pytest.fixture
def busy_writer(path: Path) -> Iterator[Child]:
    """A process that writes as fast as it can, until it is killed; sample ``ns`` can be checked."""
    with Child([sys.executable, "-c", BUSY, str(path)]) as child:
        try:
            assert until(lambda: readable(path), 60)
            yield child
        finally:
            child.kill()


def readable(path: Path) -> bool:
    try:
        return len(PoseReader(path).tracks()) == 2
    except (OSError, ValueError):
        return False


@pytest.mark.usefixtures("busy_writer")
def test_no_sample_is_torn_under_a_busy_writer(path: Path) -> None:
    """Each reading has 64 samples of two robots."""
    reader, samples, newest = PoseReader(path), 0, 0
    while samples < 200_000:
        tracks = reader.tracks()
        for name, (a, b, c) in (("goob", (1, -1, 3)), ("fred", (5, 1, -1))):
            history = tracks[name].samples
            assert all(pose == (a * ns, b * ns, c * ns) for ns, pose in history)
            samples += len(history)
        assert tracks["goob"].newest.ns >= newest
        newest = tracks["goob"].newest.ns
    assert newest > 1000, "the writer was busy"


def test_a_sample_that_is_half_written_is_left_out(path: Path) -> None:
    page = PosePage(path, ["räuber"])
    page.write(1000, [RobotPose(1.5, 2.5, 3.5)])
    page.write(2000, [RobotPose(4.5, 5.5, 6.5)])
    data = path.read_bytes()
    path.write_bytes(data.replace(struct.pack("<d", 4.5), struct.pack("<d", 4.25)))
    assert PoseReader(path).tracks()["räuber"].samples == [(1000, (1.5, 2.5, 3.5))]
    page.close()


def test_a_world_has_one_program(path: Path) -> None:
    page = PosePage(path, ["goob"])
    with pytest.raises(DeviceError, match="this world runs already"):
        PosePage(path, ["goob"])
    page.close()
    PosePage(path, ["goob"]).close()


def test_a_reader_notices_the_end_of_the_world_and_its_restart(path: Path) -> None:
    page = PosePage(path, ["goob"])
    reader = PoseReader(path)
    assert reader.is_valid
    page.close()
    assert not reader.is_valid
    with pytest.raises(FileNotFoundError):
        PoseReader(path)
    page = PosePage(path, ["fred"])
    assert not reader.is_valid
    page.write(1, [RobotPose(0, 0, 0)])
    assert list(PoseReader(path).tracks()) == ["fred"]
    page.close()


def test_the_page_of_a_killed_program_is_taken_over(busy_writer: Child, path: Path) -> None:
    reader = PoseReader(path)
    busy_writer.kill()
    busy_writer.wait(10)
    assert reader.is_valid, "a killed program removes nothing"
    page = PosePage(path, ["goob"])
    assert not reader.is_valid
    assert PoseReader(path).tracks() == {}, "nothing of the killed program is left"
    page.close()


def test_pages_of_programs_that_were_killed_long_ago_are_removed(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    abandoned = path.with_name("abandoned")
    abandoned.touch()
    running = PosePage(path.with_name("running"), ["goob"])
    PosePage(path, ["goob"]).close()
    assert abandoned.exists(), "it might belong to a program that starts just now"
    monkeypatch.setattr(pose_page, "_ABANDONED_S", -1.0)
    PosePage(path, ["goob"]).close()
    assert not abandoned.exists()
    assert path.with_name("running").exists()
    running.close()


@pytest.mark.parametrize("content", [b"", b"x" * 1000])
def test_what_is_no_page_is_refused(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    with pytest.raises(ValueError, match="is not complete"):
        PoseReader(path)


def test_a_folder_that_others_may_write_is_refused(path: Path) -> None:
    path.parent.chmod(0o777)
    with pytest.raises(DeviceError, match="is not a folder that only you may write"):
        PosePage(path, ["goob"])


def test_the_page_of_a_file_is_the_same_by_every_name_of_the_file(tmp_path: Path) -> None:
    (tmp_path / "world.json").touch()
    (tmp_path / "link.json").symlink_to("world.json")
    assert page_path(tmp_path / "link.json") == page_path(tmp_path / "world.json")
    assert page_path(tmp_path / "other.json") != page_path(tmp_path / "world.json")
