"""Worlds for tests, and what can be seen in a picture."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pebble.extensions.lab.simulation.world.poses import RobotPose, Sample, Track
from pebble.extensions.lab.simulation.world.renderer import Renderer
from pebble.extensions.lab.simulation.world.surfaces import Image
from pebble.extensions.lab.simulation.world.world_file import World, parse_world

CLEAR = {"noise": 0.0, "blur": 0.0}
_PARAMETERS = cv2.aruco.DetectorParameters()
_PARAMETERS.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
_DETECTOR = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_25h9), _PARAMETERS)


def world_of(**keys: Any) -> World:
    """A world with goob at the origin, and ``keys`` of a world file."""
    return parse_world({"robots": {"goob": {"x": 0.0, "y": 0.0}}, **keys})


def seen(world: World, size: tuple[int, int] = (640, 480), **poses: tuple[float, float, float]) -> Image:
    """What goob sees; it stands at the origin unless told otherwise."""
    picture = np.empty((size[1], size[0], 3), np.uint8)
    stands = {"goob": (0.0, 0.0, 0.0), **poses}
    tracks = {name: Track([Sample(0, RobotPose(*pose))]) for name, pose in stands.items()}
    Renderer(world, "goob", *size).render(tracks, 0, picture)
    return picture


def tags_in(picture: Image) -> dict[int, NDArray[np.float64]]:
    """The corners of each tag, (4, 2), clockwise from the upper left, by its id."""
    corners, ids, _ = _DETECTOR.detectMarkers(picture)
    numbers = [] if ids is None else ids.ravel().tolist()
    return {number: np.asarray(found[0], np.float64) for number, found in zip(numbers, corners, strict=True)}


def projected(
    world: World, tag: int, camera: tuple[float, float, float], size: tuple[int, int] = (640, 480)
) -> NDArray[np.float64]:
    """Where the corners of the black square must be, by the pinhole model; as in ``tags_in``."""
    (place,) = (place for place in world.tags if place.id == tag)
    focal = size[0] / 2 / math.tan(math.radians(world.camera.hfov_deg) / 2)
    x, y, heading = camera
    corners = []
    for aside, up in ((-1, 1), (1, 1), (1, -1), (-1, -1)):
        yaw, half = math.radians(place.yaw_deg), place.size_m / 2
        point = (place.x - math.sin(yaw) * aside * half - x, place.y + math.cos(yaw) * aside * half - y)
        ahead = point[0] * math.cos(heading) + point[1] * math.sin(heading)
        right = point[0] * math.sin(heading) - point[1] * math.cos(heading)
        down = world.camera.height_m - place.z - up * half
        corners.append(((size[0] - 1) / 2 + focal * right / ahead, (size[1] - 1) / 2 + focal * down / ahead))
    return np.array(corners)
