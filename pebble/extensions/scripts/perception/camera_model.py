"""The geometry of a camera, from the calibration file that the original's tool writes, or from its field of view."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pebble.errors import ConfigError

HFOV_DEG = 54.3  # horizontal field of view of the original's camera, a Logitech C922 at 640x480
CALIBRATION = "camera_calibration.yaml"

Floats = NDArray[np.float64]


class CameraModel:
    """A pinhole camera with distortion, for pictures of any size.

    ``matrix`` is 3x3, in pixels of a picture of ``size`` (width, height); ``distortion`` holds OpenCV's coefficients.
    """

    def __init__(self, matrix: Floats, distortion: Floats, size: tuple[int, int]) -> None:
        self.distortion = distortion
        self._matrix, self._size = matrix, size

    @classmethod
    def of_hfov(cls, hfov_deg: float = HFOV_DEG, size: tuple[int, int] = (640, 480)) -> CameraModel:
        """Return a camera with square pixels, the axis in the middle, and no distortion."""
        width, height = size
        focal = width / 2 / math.tan(math.radians(hfov_deg) / 2)
        matrix = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
        return cls(matrix, np.zeros(5), size)

    @classmethod
    def read(cls, path: Path) -> CameraModel:
        """Return the camera of a calibration file that OpenCV wrote. Raises ConfigError for any other."""
        import cv2  # late: many programs that import this need no OpenCV

        try:
            file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
            matrix, distortion = (file.getNode(name).mat() for name in ("camera_matrix", "distortion_coefficients"))
            width, height = (int(file.getNode(name).real()) for name in ("image_width", "image_height"))
        except (cv2.error, SystemError, ValueError) as error:
            raise ConfigError(f"{path}: not a calibration file: {error}") from error
        if matrix is None or distortion is None or matrix.shape != (3, 3) or min(width, height) <= 0:
            needed = "camera_matrix (3x3), distortion_coefficients, image_width and image_height"
            raise ConfigError(f"{path}: a calibration needs {needed}")
        return cls(np.asarray(matrix, float), np.asarray(distortion, float).ravel(), (width, height))

    @classmethod
    def find(cls, folders: Iterable[Path], hfov_deg: float = HFOV_DEG) -> CameraModel:
        """Return the calibration in the first of these folders that has one, else a camera of ``hfov_deg``."""
        for folder in folders:
            if (folder / CALIBRATION).is_file():
                return cls.read(folder / CALIBRATION)
        return cls.of_hfov(hfov_deg)

    def matrix(self, width: int, height: int) -> Any:
        """Return the 3x3 matrix for pictures of this size."""
        across, down = width / self._size[0], height / self._size[1]
        matrix = self._matrix * np.array([[across], [down], [1.0]])
        matrix[:2, 2] += (0.5 * (across - 1.0), 0.5 * (down - 1.0))  # pixels are counted from their middles
        return matrix
