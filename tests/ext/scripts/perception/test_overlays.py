"""Tags as payloads: as the contract has them, also where nothing is seen."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from pebble.contract import APRILTAG_DATA, APRILTAG_LOCATIONS, VIDEO_OVERLAYS, codec
from pebble.contract.payloads import TagLocations
from pebble.extensions.scripts.perception.camera_model import CameraModel
from pebble.extensions.scripts.perception.overlays import locations, overlays, tag_data, tags_in
from pebble.extensions.scripts.perception.tags import Place, Tag, TagGeometry

SIZE = (640, 480)
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
