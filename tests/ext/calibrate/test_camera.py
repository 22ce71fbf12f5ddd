"""Calibrations of a camera by rendered pictures of a tag."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pebble.config import parse
from pebble.errors import PebbleError
from pebble.extensions.calibrate import commands
from pebble.extensions.calibrate.camera import collect, read_folder, solve
from pebble.extensions.scripts.perception.camera_model import CALIBRATION, CameraModel
from pebble.extensions.scripts.perception.tags import TagFinder
from tests.ext.lab.simulation.world.worlds import seen, world_of

SIZE, FOCAL = (640, 480), 320 / math.tan(math.radians(54.3) / 2)


def views() -> Iterator[Any]:
    """Pictures of tag 13 in nine places and at three distances, turned to either side."""
    turns = itertools.cycle((200.0, 155.0, 170.0, 210.0))
    for share, row, column in itertools.product((0.1, 0.045, 0.015), (-1, 0, 1), (-1, 0, 1)):
        ahead = FOCAL * 0.25 / math.sqrt(share * SIZE[0] * SIZE[1])
        tag = {"id": 13, "x": ahead, "y": -190 * column / FOCAL * ahead, "z": 0.9 - 130 * row / FOCAL * ahead}
        yield seen(world_of(tags=[{**tag, "yaw_deg": next(turns)}], camera={"height_m": 0.9}), size=SIZE)


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pictures")
    for number, picture in enumerate(views()):
        cv2.imwrite(str(folder / f"{number:02}.png"), picture)
    (folder / "notes.txt").write_text("no picture")
    return folder


def test_a_folder_of_pictures_gives_a_file_that_opencv_and_ours_read(
    pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert commands.camera(tmp_path / "goob.json", pictures=pictures) == 0
    said = capsys.readouterr().out
    file = cv2.FileStorage(str(tmp_path / CALIBRATION), cv2.FILE_STORAGE_READ)
    assert [file.getNode(key).real() for key in ("image_width", "image_height", "marker_id", "marker_size")] == [
        640, 480, 13, 0.25,
    ]  # fmt: skip
    assert file.getNode("marker_dictionary").string() == "APRILTAG_25H9"
    assert file.getNode("num_samples").real() >= 15
    assert file.getNode("reprojection_error").real() < 0.3
    assert file.getNode("distortion_coefficients").mat().size == 5
    model = CameraModel.read(tmp_path / CALIBRATION).matrix(*SIZE)
    assert model[0, 0] == pytest.approx(FOCAL, rel=0.01)
    assert model[1, 1] == pytest.approx(FOCAL, rel=0.01)
    assert "15 of 15: " in said
    assert "the black square is 15" in said.splitlines()[-1]
    assert said.splitlines()[-1].endswith("a tape from the lens to it reads 1.00 m")


class Quiet:
    """A person to whom nothing is told."""

    def tell(self, line: str) -> None:
        pass

    def ask(self, question: str) -> str:
        raise AssertionError


def test_of_a_camera_pictures_of_a_tag_at_rest_count_alone(pictures: Path) -> None:
    shown = list(itertools.islice(read_folder(pictures), 4))
    moving = [picture for picture in shown for _ in range(2)]
    resting = [picture for picture in shown for _ in range(5)]
    assert collect(moving, TagFinder(), 13, Quiet(), still=False)[0] == []
    assert len(collect(resting, TagFinder(), 13, Quiet(), still=False)[0]) == 4


def test_what_cannot_be_measured_is_refused(pictures: Path, tmp_path: Path) -> None:
    corners, _ = collect(read_folder(pictures), TagFinder(), 13, Quiet(), still=True)
    with pytest.raises(PebbleError, match="14 pictures of the tag in different places: 15 are needed"):
        solve(corners[:14], SIZE, 0.25)
    shaken = [four + np.random.default_rng(1).normal(0, 8, (4, 2)) for four in corners]
    with pytest.raises(PebbleError, match=r"the pictures fit to \d+\.\d+ pixels only, more than 1"):
        solve(shaken, SIZE, 0.25)
    with pytest.raises(PebbleError, match="there is no picture"):
        next(read_folder(tmp_path))


def test_without_a_tag_nothing_is_measured(tmp_path: Path, pictures: Path) -> None:
    config = parse({"robot": {"id": "goob"}}, folder=tmp_path, env={})
    with pytest.raises(PebbleError, match="0 pictures of the tag"):
        commands.camera(config.folder / "goob.json", tag=7, pictures=pictures)
    assert not (tmp_path / CALIBRATION).exists()
