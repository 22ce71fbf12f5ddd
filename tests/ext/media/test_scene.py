"""The synthetic scene: always the same, always moving, and its counter survives what pictures go through."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from pebble.extensions.media.scene import COUNTER_LIMIT, TAG_ID, Scene
from tests.kit.scene import read_counter
from tests.support import cases, some

NUMBERS = some((0, 1, 2, 255, 0xABCDEF, 256, 65_535, COUNTER_LIMIT - 1), 4)


def picture(number: int, width: int = 640, height: int = 480) -> np.ndarray:
    out = np.empty((height, width, 3), np.uint8)
    Scene(width, height).render(number, out)
    return out


def jpeg(image: np.ndarray, quality: int = 10) -> np.ndarray:
    return cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_COLOR)


@pytest.mark.parametrize("size", [(640, 480), (1920, 1080), (1280, 720), (352, 288)])
@pytest.mark.parametrize("number", NUMBERS)
def test_the_counter_survives_coarse_coding_and_shrinking(size: tuple[int, int], number: int) -> None:
    small = cv2.resize(jpeg(picture(number, *size)), (320, 240), interpolation=cv2.INTER_AREA)
    assert read_counter(jpeg(small)) == number
    assert read_counter(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY)) == number


def test_the_tag_can_be_found() -> None:
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11))
    scene, out = Scene(640, 480), np.empty((480, 640, 3), np.uint8)
    for number in range(0, 450, cases(45, 15)):
        scene.render(number, out)
        assert TAG_ID in np.ravel(detector.detectMarkers(out)[1]), number
