"""What a camera sees of a world: where tags are, what hides what, and each fault of the camera."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from tests.ext.lab.simulation.world.worlds import CLEAR, projected, seen, tags_in, world_of

WALL = {"x1": 1.0, "y1": 1.0, "x2": 1.0, "y2": -1.0}
TAG = {"id": 13, "x": 2.0, "y": 0.0, "yaw_deg": 180.0}
CAMERAS = [
    (0.0, 0.0, 0.0),
    (0.0, 0.0, 0.35),
    (-0.5, -1.0, 0.5),
    (3.2, 0.3, math.pi),  # of the other tag
]


def both_tags(**keys: Any) -> Any:
    return world_of(tags=[TAG, {**TAG, "id": 4, "x": 2.02, "yaw_deg": 0.0}], **keys)


@pytest.mark.parametrize("camera", CAMERAS)
def test_a_tag_is_where_the_pinhole_model_puts_it(camera: tuple[float, float, float]) -> None:
    world = both_tags()
    ((number, corners),) = tags_in(seen(world, size=(1280, 720), goob=camera)).items()
    assert np.abs(corners - projected(world, number, camera, (1280, 720))).max() < 1.0


NEAR = {**TAG, "y": 0.5, "size_m": 0.1}
AWAY = {"x1": 0.5, "y1": 0.15, "x2": 6.0, "y2": -0.5}
FRED = {"goob": {"x": 0, "y": 0}, "fred": {"x": 1.5, "y": 0, "tag": 2}}
THREE = {name: {"x": x, "y": 0.0, "tag": tag} for name, x, tag in (("goob", 0.0, 1), ("fred", 1.0, 2), ("ben", 2.0, 3))}
BEHIND = {"robots": THREE, "tags": [{**TAG, "x": 3.0, "size_m": 0.1, "z": 0.1}]}
#: Keys of a world, where robots stand, and the tags that goob sees.
SCENES: list[tuple[dict[str, Any], dict[str, Any], set[int]]] = [
    ({"tags": [TAG]}, {}, {13}),
    ({"tags": [TAG], "walls": [WALL]}, {}, set()),
    ({"tags": [NEAR], "walls": [AWAY]}, {}, set()),  # nearer than the middle of the wall
    ({"tags": [{**TAG, "z": 0.5}], "walls": [{**WALL, "height_m": 0.2}]}, {}, {13}),
    ({"tags": [{**TAG, "x": 1.0, "y": 0.3}], "walls": [WALL]}, {}, {13}),  # on the wall
    ({"tags": [{**TAG, "x": 1.0}], "walls": [WALL]}, {"goob": (2.0, 0.0, math.pi)}, set()),  # from behind
    ({"robots": FRED, "walls": [WALL]}, {"fred": (1.3, 0.0, 0.2)}, set()),
    ({"robots": FRED, "walls": [WALL]}, {"fred": (0.8, 0.0, 0.2)}, {2}),
    (BEHIND, {"fred": (1.2, 0, 0), "ben": (0.6, 0, 0)}, {3}),
    (BEHIND, {"fred": (0.8, 0.3, 0), "ben": (1.2, -0.4, 0)}, {2, 3, 13}),
]


@pytest.mark.parametrize(("keys", "poses", "tags"), SCENES)
def test_walls_and_robots_hide_what_is_behind_them(keys: dict[str, Any], poses: dict[str, Any], tags: set[int]) -> None:
    assert set(tags_in(seen(world_of(**keys), **poses))) == tags


@pytest.mark.parametrize(
    ("fault", "least", "most"),
    [({"noise": 8.0}, 6, 7), ({"blur": 3.0}, 2, 4), ({"jpeg_quality": 10}, 3, 5), ({}, -1, 0)],
)
def test_a_fault_of_the_camera_changes_each_pixel_by_so_much(fault: dict[str, float], least: int, most: int) -> None:
    clear, faulty = (seen(world_of(tags=[TAG], camera={**CLEAR, **keys})) for keys in ({}, fault))
    assert least < np.abs(faulty.astype(np.int16) - clear).mean() <= most
