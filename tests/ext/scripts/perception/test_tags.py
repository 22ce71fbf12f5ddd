"""Tags in pictures whose geometry is known."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pebble.contract import APRILTAG_DATA, APRILTAG_LOCATIONS, VIDEO_OVERLAYS, codec
from pebble.contract.payloads import TagLocations
from pebble.errors import ConfigError, PebbleError
from pebble.extensions.scripts.perception.camera_model import CALIBRATION, CameraModel
from pebble.extensions.scripts.perception.overlays import locations, overlays, tag_data, tags_in
from pebble.extensions.scripts.perception.tags import Place, Tag, TagFinder, TagGeometry, largest

SIZE = (640, 480)
EDGE_M = 0.25
CELL = 40  # pixels of the printed tag


def picture(
    number: int,
    *,
    ahead_m: float,
    right_m: float = 0.0,
    yaw: float = 0.0,
    camera: CameraModel | None = None,
    dictionary: int = cv2.aruco.DICT_APRILTAG_25h9,
) -> tuple[Any, Any]:
    """A tag on a grey ground, and its true corners in pixels: 4x2, clockwise from its upper left."""
    tags = cv2.aruco.getPredefinedDictionary(dictionary)
    cells = tags.markerSize + 2
    printed = cv2.aruco.generateImageMarker(tags, number, cells * CELL)
    printed = cv2.copyMakeBorder(printed, CELL, CELL, CELL, CELL, cv2.BORDER_CONSTANT, value=255)
    matrix = (camera or CameraModel.of_hfov()).matrix(*SIZE)
    half, turn = EDGE_M / 2, (math.cos(yaw), math.sin(yaw))
    rotation = np.array([[turn[0], 0, turn[1]], [0, 1, 0], [-turn[1], 0, turn[0]]])
    square = np.array([[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]])  # y down
    points = square @ rotation.T + np.array([right_m, 0.0, ahead_m])
    corners = points @ matrix.T
    corners = corners[:, :2] / corners[:, 2:]
    low, high = CELL - 0.5, CELL + cells * CELL - 0.5
    source = np.array([[low, low], [high, low], [high, high], [low, high]], np.float32)
    warp = cv2.getPerspectiveTransform(source, corners.astype(np.float32))
    ground = np.full((SIZE[1], SIZE[0]), 150, np.uint8)
    cv2.warpPerspective(printed, warp, SIZE, ground, cv2.INTER_AREA, cv2.BORDER_TRANSPARENT)
    return cv2.cvtColor(ground, cv2.COLOR_GRAY2BGR), corners


@pytest.mark.parametrize(("ahead", "right", "yaw"), [(0.6, 0.0, 0.0), (2.0, 0.8, -0.4), (2.8, 0.0, 0.6)])
def test_a_tag_is_found_where_it_is(ahead: float, right: float, yaw: float) -> None:
    image, corners = picture(13, ahead_m=ahead, right_m=right, yaw=yaw)
    (tag,) = TagFinder(EDGE_M).find(image)
    assert tag.id == 13
    assert np.abs(tag.corners - corners).max() < 0.7, "clockwise from the upper left of the tag"
    assert tag.distance_m == pytest.approx(math.hypot(ahead, right), rel=0.02)
    assert tag.angle_rad == pytest.approx(math.atan2(right, ahead), abs=0.005)


def test_tags_come_in_the_order_of_their_ids_and_grey_pictures_do() -> None:
    left, _ = picture(20, ahead_m=2.0, right_m=-0.6)
    right, _ = picture(4, ahead_m=2.0, right_m=0.6)
    left[:, SIZE[0] // 2 :] = right[:, SIZE[0] // 2 :]
    assert [tag.id for tag in TagFinder(EDGE_M).find(left)] == [4, 20]
    assert [tag.id for tag in TagFinder(EDGE_M).find(left[:, :, 0])] == [4, 20]


@pytest.mark.parametrize("family", ["apriltag_36h11", "DICT_APRILTAG_36h11"])
def test_families_are_spelled_as_the_original_does(family: str) -> None:
    image, _ = picture(7, ahead_m=1.0, dictionary=cv2.aruco.DICT_APRILTAG_36h11)
    assert [tag.id for tag in TagFinder(EDGE_M, family=family).find(image)] == [7]
    assert TagFinder(EDGE_M).find(image) == [], "not of the default family"


def test_an_unknown_family_is_named_with_the_known_ones() -> None:
    with pytest.raises(PebbleError, match=r"unknown tag family 'APRILTAG_99H9'; known: .*APRILTAG_25H9"):
        TagFinder(family="APRILTAG_99H9")


@pytest.mark.parametrize(
    "corners", [np.zeros((4, 2)), np.full((4, 2), 0.5), np.array([[0, 0], [9, 9], [0, 0], [9, 9]])]
)
def test_corners_of_no_square_have_no_place(corners: Any) -> None:
    place = TagGeometry(EDGE_M).place(corners, *SIZE)
    assert place is None or math.isfinite(place.distance_m)


def test_opencv_uses_one_thread() -> None:
    cv2.setNumThreads(2)
    TagFinder()
    assert cv2.getNumThreads() == 1


CALIBRATED = """%YAML:1.0
---
image_width: 320
image_height: 240
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 250., 0., 150., 0., 250., 120., 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ 0., 0., 0., 0., 0. ]
"""


def test_a_calibration_is_read_from_the_first_folder_that_has_one_and_scaled(tmp_path: Path) -> None:
    folders = [tmp_path / "script", tmp_path / "config"]
    for folder in folders:
        folder.mkdir()
    assert CameraModel.find(folders).matrix(*SIZE)[0, 0] == pytest.approx(624, abs=1), "without one, the original's"
    (folders[1] / CALIBRATION).write_text(CALIBRATED)
    camera = CameraModel.find(folders)
    assert camera.matrix(*SIZE)[0] == pytest.approx([500.0, 0.0, 300.5])
    image, _ = picture(13, ahead_m=1.0, right_m=0.3, camera=camera)
    (tag,) = TagFinder(EDGE_M, camera).find(image)
    assert (tag.distance_m, tag.angle_rad) == pytest.approx((math.hypot(1, 0.3), math.atan(0.3)), rel=0.02)


@pytest.mark.parametrize("text", ["nonsense", "%YAML:1.0\n---\nimage_width: 3\n", CALIBRATED.replace("320", "0")])
def test_a_file_that_is_no_calibration_is_named(tmp_path: Path, text: str) -> None:
    (tmp_path / CALIBRATION).write_text(text)
    with pytest.raises(ConfigError, match=CALIBRATION):
        CameraModel.find([tmp_path])


# -- several tags with one id

RIGHT, FAR = (1.0, 0.3), (2.0, 0.1)  # metres, radians


def seen(distance_m: float, angle_rad: float, *, number: int = 13) -> Tag:
    """A tag in that place, with an edge of as many pixels as it has at that distance."""
    edge, x = 100.0 / distance_m, 320.0 + 500.0 * angle_rad
    corners = np.array([[x, 200], [x + edge, 200], [x + edge, 200 + edge], [x, 200 + edge]])
    return Tag(number, corners, Place(distance_m, angle_rad))


def test_the_largest_of_several_is_chosen() -> None:
    tags = [seen(*FAR), seen(*RIGHT), seen(0.5, 0.0, number=7)]
    assert (largest(tags, 13), largest(tags, 1), largest([], 13)) == (tags[1], None, None)


def test_the_finder_lists_all_tags_of_an_id_the_largest_first() -> None:
    small, _ = picture(13, ahead_m=1.6, right_m=-0.6)
    large, _ = picture(13, ahead_m=1.0, right_m=0.3)
    small[:, 320:] = large[:, 320:]
    tags = TagFinder(EDGE_M).find(small)
    assert [tag.id for tag in tags] == [13, 13]
    assert [tag.distance_m for tag in tags] == [pytest.approx(1.04, rel=0.05), pytest.approx(1.71, rel=0.05)]


COLOURS = np.full((48, 64, 3), 150, np.uint8)


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        (None, "not NoneType"),
        (COLOURS / 255.0, "not of float64"),
        (np.dstack([COLOURS, COLOURS[:, :, 0]]), r"picture\[:, :, :3\]"),
        (COLOURS[:, :, :1], r"picture\[:, :, 0\]"),
        (COLOURS[:, :, :2], r"not of \(48, 64, 2\)"),
        (COLOURS[:0], r"not of \(0, 64, 3\)"),
    ],
)
def test_what_is_no_picture_is_refused_with_a_sentence(wrong: Any, why: str) -> None:
    with pytest.raises(PebbleError, match=r"a picture is a numpy array of \(height, width, 3\) bytes.*" + why):
        TagFinder().find(wrong)


# -- tags as payloads: as the contract has them, also where nothing is seen


TAG = Tag(13, np.array([[64, 48], [128, 48], [128, 96], [64, 96]]), Place(0.74, -0.11))
NORM = [[0.1, 0.1], [0.2, 0.1], [0.2, 0.2], [0.1, 0.2]]


def test_locations() -> None:
    got = json.loads(codec.encode(APRILTAG_LOCATIONS, locations("apriltag-locations", [TAG], SIZE, 5.0)))
    (detection,) = got["detections"]
    assert np.allclose(detection.pop("corners_norm"), NORM)
    assert np.allclose(detection.pop("center_norm"), [0.15, 0.15])
    assert detection == {"marker_id": 13}
    frame = {"frame_width": 640, "frame_height": 480, "timestamp": 5.0}
    assert got | {"detections": []} == {"source": "apriltag-locations", "detections": [], **frame}
    outside = Tag(1, np.array([[-3, 0], [700, 0], [700, 500], [0, 500]]), Place(1.0, 0.0))
    (detection,) = locations("s", [outside], SIZE, 0.0).detections
    assert detection.corners_norm == [(0, 0), (1, 0), (1, 1), (0, 1)], "clamped"


def test_overlays() -> None:
    got = json.loads(codec.encode(VIDEO_OVERLAYS, overlays("apriltag-follow", [TAG], SIZE, 5.0)))
    assert np.allclose(got["shapes"], [NORM])
    assert [label["marker_id"] for label in got["labels"]] == [13]
    assert (got["source"], got["frame_width"], got["frame_height"]) == ("apriltag-follow", 640, 480)


def test_the_followed_tag_and_none() -> None:
    seen = json.loads(codec.encode(APRILTAG_DATA, tag_data(13, TAG, SIZE, 5.0)))
    assert np.allclose(seen.pop("corners_norm"), NORM)
    assert seen == {"detected": True, "marker_id": 13, "distance_m": 0.74, "angle_rad": -0.11, "timestamp": 5.0}
    assert b'"of"' not in codec.encode(APRILTAG_DATA, tag_data(13, TAG, SIZE, 5.0, of=1))
    assert json.loads(codec.encode(APRILTAG_DATA, tag_data(13, TAG, SIZE, 5.0, of=2)))["of"] == 2
    none = json.loads(codec.encode(APRILTAG_DATA, tag_data(13, None, SIZE, 5.0)))
    unknown = {"corners_norm": [], "distance_m": None, "angle_rad": None}
    assert none == {"detected": False, "marker_id": 13, **unknown, "timestamp": 5.0}


def test_a_tag_that_another_program_found_has_its_place() -> None:
    half = 0.125 / 2.0 * CameraModel.of_hfov().matrix(*SIZE)[0, 0]
    square = np.array([[-half, -half], [half, -half], [half, half], [-half, half]]) + np.array([319.5, 239.5])
    payload = locations("s", [Tag(13, square, Place(0.0, 0.0))], SIZE, 0.0)
    (tag,) = tags_in(payload, 13, TagGeometry(0.25))
    assert tag.place == pytest.approx((2.0, 0.0, 0.0), abs=1e-6)
    assert math.isfinite(tag.distance_m)
    assert tags_in(payload, 14, TagGeometry(0.25)) == []
    empty = TagLocations(source="s", detections=payload.detections, frame_width=0, frame_height=0, timestamp=0.0)
    assert tags_in(empty, 13, TagGeometry(0.25)) == []
