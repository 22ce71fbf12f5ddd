"""The fit of wheels to runs, and calibrations of a camera by rendered pictures of a tag."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import cv2
import numpy as np
import pytest

from pebble.errors import PebbleError
from pebble.extensions.calibrate import commands
from pebble.extensions.calibrate.camera import collect, read_folder, solve
from pebble.extensions.calibrate.fit import NOISE, Fit, Run, fit
from pebble.extensions.calibrate.wheels import arc, between
from pebble.extensions.scripts.perception.camera_model import CALIBRATION, CameraModel
from pebble.extensions.scripts.perception.tags import Place, TagFinder
from tests.ext.lab.simulation.world.worlds import seen, world_of
from tests.support import cases

BELIEVED = (19.164, 19.164), 130.5
LEFT, RIGHT, TRACK = 19.36, 18.97, 134.4


def runs_of(seed: int, truth: str, slip: float) -> list[Run]:
    """Six straights and two spins, with the errors of ``truth``; ``slip`` is a part of the way."""
    random, noise = np.random.default_rng(seed), NOISE[truth]

    def run(name: str, left_mm: float, right_mm: float, *, spin: bool) -> Run:
        left_steps, right_steps = (
            mm / step * (1 + random.normal(0, slip)) for mm, step in ((left_mm, LEFT), (right_mm, RIGHT))
        )
        turn = (right_mm - left_mm) / TRACK + random.normal(0, noise.spin_rad if spin else noise.straight_rad)
        return Run(
            name, left_steps, right_steps, turn, None if spin else (left_mm + right_mm) / 2 + random.normal(0, 2)
        )

    ways = [
        (sign * 1500 - drift, sign * 1500 + drift)
        for sign, drift in zip((1, -1) * 3, random.normal(0, 5, 6), strict=True)
    ]
    spins = [sign * 3 * math.pi * TRACK for sign in (1, -1)]
    straights = [run(f"straight {number}", *way, spin=False) for number, way in enumerate(ways)]
    return straights + [run(f"spin {number}", -mm, mm, spin=True) for number, mm in enumerate(spins)]


def off_percent(result: Fit) -> tuple[float, float, float]:
    true = zip((result.left_step_mm, result.right_step_mm, result.track_mm), (LEFT, RIGHT, TRACK), strict=True)
    left, right, track = (100 * abs(value / wanted - 1) for value, wanted in true)
    return left, right, track


@pytest.mark.parametrize(("truth", "step", "track"), [("tape", 0.3, 0.47), ("gyro", 0.28, 0.42)])
def test_95_of_100_calibrations_are_as_exact_as_the_document_says(truth: str, step: float, track: float) -> None:
    off = [off_percent(fit(runs_of(seed, truth, 0.003), NOISE[truth], *BELIEVED)) for seed in range(cases(200, 400))]
    left, right, tracks = np.percentile(off, 95, axis=0)
    assert max(left, right) < step * 1.15
    assert tracks < track * 1.15


def test_a_run_that_does_not_fit_is_the_worst() -> None:
    runs = runs_of(1, "tape", 0.001)
    assert fit(runs, NOISE["tape"], *BELIEVED).worst is None
    assert runs[2].mm is not None
    wrong = [*runs[:2], runs[2]._replace(mm=runs[2].mm + 60), *runs[3:]]
    result = fit(wrong, NOISE["tape"], *BELIEVED)
    assert result.worst == 2
    assert result.mm[2] == max(result.mm)


@pytest.mark.parametrize(("sign", "turn_deg"), [(1, 0.0), (-1, 12.0), (1, -12.0)])
def test_the_arc_by_a_tape_and_by_a_tag_is_the_one_that_was_driven(sign: int, turn_deg: float) -> None:
    mm, turn = sign * 1500.0, math.radians(turn_deg)
    radius = mm / turn if turn else math.inf
    end = (radius * math.sin(turn), radius * (1 - math.cos(turn))) if turn else (mm, 0.0)
    by_tape = arc(*end)
    tag = (2300.0, 150.0)

    def place(x: float, y: float, heading: float) -> Place:
        ahead, left = tag[0] - x, tag[1] - y
        angle = heading - math.atan2(left, ahead)
        return Place(math.hypot(ahead, left, 80.0) / 1000, angle, -0.08)

    by_tag = between(place(0.0, 0.0, 0.0), place(*end, turn))
    for moved in (by_tape, by_tag):
        assert moved.mm == pytest.approx(mm)
        assert moved.turn_rad == pytest.approx(turn, abs=1e-9)


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


QUIET = Mock(spec=["tell"])  # a person who is asked nothing


def test_of_a_camera_pictures_of_a_tag_at_rest_count_alone(pictures: Path) -> None:
    shown = list(itertools.islice(read_folder(pictures), 4))
    moving = [picture for picture in shown for _ in range(2)]
    resting = [picture for picture in shown for _ in range(5)]
    assert collect(moving, TagFinder(), 13, QUIET, still=False)[0] == []
    assert len(collect(resting, TagFinder(), 13, QUIET, still=False)[0]) == 4


def test_what_cannot_be_measured_is_refused_and_not_written(pictures: Path, tmp_path: Path) -> None:
    corners, _ = collect(read_folder(pictures), TagFinder(), 13, QUIET, still=True)
    with pytest.raises(PebbleError, match="14 pictures of the tag in different places: 15 are needed"):
        solve(corners[:14], SIZE, 0.25)
    few = tmp_path / "few"
    few.mkdir()
    (few / "00.png").write_bytes((pictures / "00.png").read_bytes())
    with pytest.raises(PebbleError, match="0 pictures of the tag"):
        commands.camera(tmp_path / "goob.json", tag=7, pictures=few)
    assert not (tmp_path / CALIBRATION).exists()
    shaken = [four + np.random.default_rng(1).normal(0, 8, (4, 2)) for four in corners]
    with pytest.raises(PebbleError, match=r"the pictures fit to \d+\.\d+ pixels only, more than 1"):
        solve(shaken, SIZE, 0.25)
    (few / "00.png").unlink()
    with pytest.raises(PebbleError, match="there is no picture"):
        next(read_folder(few))
