"""AprilTags in a picture, by OpenCV: their ids, distances and directions."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from pebble.errors import PebbleError
from pebble.extensions.scripts.perception.camera_model import CameraModel, Floats

FAMILY = "APRILTAG_25H9"  # the original's default, in its spelling
_PICTURE = "a picture is a numpy array of (height, width, 3) bytes, blue first, or (height, width)"
#: By the number of colours.
_HINTS = {(4,): ": leave out the last with picture[:, :, :3]", (1,): ": use picture[:, :, 0]"}


class Place(NamedTuple):
    """The place of a tag's middle as seen from the camera; ``angle_rad`` is positive to the right."""

    distance_m: float
    angle_rad: float
    down_m: float = 0.0  # below the camera's axis


class Tag(NamedTuple):
    """A tag in a picture.

    ``corners``: 4x2 pixels, clockwise from the upper left of the tag as it is printed, which is OpenCV's order and the
    contract's. The C library of AprilTag begins one corner earlier.
    """

    id: int
    corners: Floats
    place: Place

    @property
    def distance_m(self) -> float:
        return self.place.distance_m

    @property
    def angle_rad(self) -> float:
        return self.place.angle_rad

    @property
    def area(self) -> float:
        """Area in square pixels."""
        x, y = self.corners.T
        return abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2


class TagGeometry:
    """A converter of the corners of a tag of ``size_m`` (edge of its black square) to its place."""

    def __init__(self, size_m: float, camera: CameraModel | None = None) -> None:
        half = size_m / 2
        self._square = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
        self._camera = camera or CameraModel.of_hfov()

    def place(self, corners: Floats, width: int, height: int) -> Place | None:
        """Return the place of a tag by its ``corners``; None if they are no square in front of a camera.

        ``corners`` are those of :class:`Tag`, in a picture of this size.
        """
        import cv2

        matrix, distortion = self._camera.matrix(width, height), self._camera.distortion
        points = np.asarray(corners, float).reshape(4, 1, 2)
        try:
            solved, _, middle = cv2.solvePnP(self._square, points, matrix, distortion, flags=cv2.SOLVEPNP_IPPE_SQUARE)
        except cv2.error:
            return None
        if not solved or middle is None:
            return None
        right, down, ahead = (float(part) for part in np.ravel(middle))
        distance = math.sqrt(right * right + down * down + ahead * ahead)
        if not math.isfinite(distance) or ahead <= 0.0:
            return None
        return Place(distance, math.atan2(right, ahead), down)


class TagFinder:
    """A finder of tags of one family and size. ``family`` is spelled as in the original, such as ``APRILTAG_25H9``."""

    def __init__(self, size_m: float = 0.25, camera: CameraModel | None = None, family: str = FAMILY) -> None:
        """Make a finder. Raises PebbleError for an unknown family."""
        import cv2  # late: it takes 15 MB and 0.2 s

        cv2.setNumThreads(1)  # more are slower at this size, and take processors from other programs
        parameters = cv2.aruco.DetectorParameters()
        parameters.minDistanceToBorder = 1  # pixels: a near tag fills the picture
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        self._cv2: Any = cv2
        self._detector: Any = cv2.aruco.ArucoDetector(_dictionary(cv2.aruco, family), parameters)
        self._geometry = TagGeometry(size_m, camera)

    def find(self, picture: Any) -> list[Tag]:
        """Return all tags in a picture, ordered by id; of several with one id the largest first.

        ``picture`` is an array (height, width, 3) of bytes, blue first, or (height, width). It is not rotated here:
        av_daemon has done that. Raises PebbleError for anything else.
        """
        picture = _checked(picture)
        height, width = picture.shape[:2]
        grey = picture if picture.ndim == 2 else self._cv2.cvtColor(picture, self._cv2.COLOR_BGR2GRAY)
        corners, ids, _ = self._detector.detectMarkers(grey)
        numbers: Any = [] if ids is None else np.ravel(ids)
        tags = []
        for tag_corners, number in zip(corners, numbers, strict=False):
            four = np.asarray(tag_corners, float).reshape(4, 2)
            place = self._geometry.place(four, width, height)
            if place is not None:
                tags.append(Tag(int(number), four, place))
        return sorted(tags, key=lambda tag: (tag.id, -tag.area))


def _checked(picture: Any) -> Any:
    """Return a picture in the form that OpenCV takes. Raises PebbleError for anything else."""
    if not isinstance(picture, np.ndarray):
        raise PebbleError(f"{_PICTURE}, not {type(picture).__name__}")
    if picture.dtype != np.uint8:
        raise PebbleError(f"{_PICTURE}, not of {picture.dtype}")
    colours = picture.shape[2:]  # (3,) for colours, () for grey
    if not (picture.ndim == 2 or (picture.ndim == 3 and picture.shape[2] == 3)) or not picture.size:
        raise PebbleError(f"{_PICTURE}, not of {picture.shape}{_HINTS.get(colours, '')}")
    return np.ascontiguousarray(picture)


def largest(tags: Sequence[Tag], tag_id: int) -> Tag | None:
    """Return the tag with this id that looks largest; None if there is none."""
    return max((tag for tag in tags if tag.id == tag_id), key=lambda tag: tag.area, default=None)


def _dictionary(aruco: Any, family: str) -> Any:
    names = {name.upper(): name for name in dir(aruco) if name.startswith("DICT_")}
    name = names.get("DICT_" + family.strip().upper().removeprefix("DICT_"))
    if name is None:
        families = ", ".join(sorted(name.removeprefix("DICT_") for name in names if "APRILTAG" in name))
        raise PebbleError(f"unknown tag family {family!r}; known: {families}")
    return aruco.getPredefinedDictionary(getattr(aruco, name))
