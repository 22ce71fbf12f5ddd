"""AprilTags in a picture, with OpenCV: which they are, how far away, and in which direction."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from pebble.errors import PebbleError
from pebble.perception.camera_model import CameraModel, Floats

FAMILY = "APRILTAG_25H9"  # the original's default, in its spelling
_HIDDEN_S = 0.7  # a tag that is out of sight for longer is lost, as followers have it: another one may be chosen
_PICTURE = "a picture is a numpy array of (height, width, 3) bytes, blue first, or (height, width)"
_HINTS = {(4,): ": leave out the last with picture[:, :, :3]", (1,): ": use picture[:, :, 0]"}
_AS_LARGE = 0.9  # of two areas: the difference is noise


class Place(NamedTuple):
    """Where the middle of a tag is, seen from the camera; ``angle_rad`` is positive to the right."""

    distance_m: float
    angle_rad: float


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
        """The area in square pixels."""
        x, y = self.corners.T
        return abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2


class TagGeometry:
    """The place of a tag of ``size_m`` (edge of its black square) from its corners."""

    def __init__(self, size_m: float, camera: CameraModel | None = None) -> None:
        half = size_m / 2
        self._square = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
        self._camera = camera or CameraModel.of_hfov()

    def place(self, corners: Floats, width: int, height: int) -> Place | None:
        """``corners`` as in :class:`Tag`, in a picture of this size. None: they are no square in front of a camera."""
        import cv2

        matrix, distortion = self._camera.matrix(width, height), self._camera.distortion
        points = np.asarray(corners, float).reshape(4, 1, 2)
        try:
            found, _, middle = cv2.solvePnP(self._square, points, matrix, distortion, flags=cv2.SOLVEPNP_IPPE_SQUARE)
        except cv2.error:
            return None
        if not found or middle is None:
            return None
        right, down, ahead = (float(part) for part in np.ravel(middle))
        distance = math.sqrt(right * right + down * down + ahead * ahead)
        if not math.isfinite(distance) or ahead <= 0.0:
            return None
        return Place(distance, math.atan2(right, ahead))


class TagFinder:
    """Finds tags of one family and size. ``family`` is spelled as the original does, such as ``APRILTAG_25H9``."""

    def __init__(self, size_m: float = 0.25, camera: CameraModel | None = None, family: str = FAMILY) -> None:
        """Raises PebbleError for an unknown family."""
        import cv2  # late: it takes 15 MB and 0.2 s

        cv2.setNumThreads(1)  # more are slower at this size, and take processors from other programs
        parameters = cv2.aruco.DetectorParameters()
        parameters.minDistanceToBorder = 1  # pixels: a near tag fills the picture
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        self._cv2: Any = cv2
        self._detector: Any = cv2.aruco.ArucoDetector(_dictionary(cv2.aruco, family), parameters)
        self._geometry = TagGeometry(size_m, camera)

    def find(self, picture: Any) -> list[Tag]:
        """All tags in an array of (height, width, 3) bytes, blue first, or (height, width), in the order of their ids.

        Of several with one id the largest is the first; see :class:`TagChoice`.

        Pictures are used as they come: av_daemon has rotated them. Raises PebbleError for anything else.
        """
        picture = _checked(picture)
        height, width = picture.shape[:2]
        grey = picture if picture.ndim == 2 else self._cv2.cvtColor(picture, self._cv2.COLOR_BGR2GRAY)
        corners, ids, _ = self._detector.detectMarkers(grey)
        tags = []
        for found, number in zip(corners, [] if ids is None else np.ravel(ids), strict=False):
            four = np.asarray(found, float).reshape(4, 2)
            if (place := self._geometry.place(four, width, height)) is not None:
                tags.append(Tag(int(number), four, place))
        return sorted(tags, key=lambda tag: (tag.id, -tag.area))


def _checked(picture: Any) -> Any:
    if not isinstance(picture, np.ndarray):
        raise PebbleError(f"{_PICTURE}, not {type(picture).__name__}")
    if picture.dtype != np.uint8:
        raise PebbleError(f"{_PICTURE}, not of {picture.dtype}")
    if not (picture.ndim == 2 or (picture.ndim == 3 and picture.shape[2] == 3)) or not picture.size:
        raise PebbleError(f"{_PICTURE}, not of {picture.shape}{_HINTS.get(picture.shape[2:], '')}")
    return np.ascontiguousarray(picture)


class TagChoice:
    """Chooses the same one of several tags with one id, from picture to picture.

    It is the one nearest to the last chosen one, as seen from the camera; at first, and 0.7 s after that was seen last,
    the largest; of equally large ones the leftmost. While the chosen one alone is hidden, none is chosen.
    """

    def __init__(self, tag_id: int) -> None:
        self.count = 0  # of the tags with this id in the last picture
        self.remark = ""  # which one was chosen, if there were several
        self._id = tag_id
        self._last: Place | None = None
        self._seen_at = float("-inf")
        self._others: list[Place] = []  # of the newest picture that had others, if that is not long ago
        self._others_at = float("-inf")

    def choose(self, tags: Sequence[Tag], now: float) -> Tag | None:
        """The tag to use of those in a picture; None: it is not there. ``now`` is in seconds of any clock."""
        same = [tag for tag in tags if tag.id == self._id]
        self.count, self.remark = len(same), ""
        if now - self._seen_at > _HIDDEN_S:
            self._last = None
        if now - self._others_at > _HIDDEN_S:
            self._others = []
        chosen = self._chosen(same)
        if others := [tag.place for tag in same if tag is not chosen]:
            self._others, self._others_at = others, now
        if chosen is None:
            if same:
                self.remark = f"the tag with id {self._id} is hidden: another one with this id is used if it stays so"
            return None
        if others:
            degrees, why = math.degrees(chosen.angle_rad), "nearest to the last one" if self._last else "the largest"
            where = f"{abs(degrees):.0f} degrees to the {'left' if degrees < 0.0 else 'right'}"
            self.remark = f"{len(same)} tags with id {self._id}: using the one {where}, {why}"
        self._last, self._seen_at = chosen.place, now
        return chosen

    def _chosen(self, same: list[Tag]) -> Tag | None:
        last = self._last
        if last is None:
            largest = max((tag.area for tag in same), default=0.0)
            return min((tag for tag in same if tag.area >= _AS_LARGE * largest), key=_corner, default=None)
        places = [
            (_apart(tag.place, last), _corner(tag), tag)
            for tag in same
            if all(_apart(tag.place, last) <= _apart(tag.place, other) for other in self._others)
        ]
        return min(places, key=lambda place: place[:2], default=(None, None, None))[2]


class TagOrder:
    """Sorts the tags of each picture by id, and of one id the same tag first as in the picture before."""

    def __init__(self) -> None:
        self.remarks: list[str] = []  # on the last picture
        self._choices: dict[int, TagChoice] = {}  # not more than the family has ids

    def sort(self, tags: Sequence[Tag], now: float) -> list[Tag]:
        choices = {tag.id: self._choices.setdefault(tag.id, TagChoice(tag.id)) for tag in tags}
        chosen = {number: choice.choose(tags, now) for number, choice in choices.items()}
        self.remarks = [choice.remark for choice in choices.values() if choice.remark]
        return sorted(tags, key=lambda tag: (tag.id, tag is not chosen[tag.id], -tag.area))


def _corner(tag: Tag) -> tuple[float, float]:
    return float(tag.corners[:, 0].min()), float(tag.corners[:, 1].min())


def _apart(one: Place, other: Place) -> float:
    """How different two places look from the camera: by their angle, and by the ratio of their distances."""
    ratio = (one.distance_m + 0.001) / (other.distance_m + 0.001)
    return math.hypot(one.angle_rad - other.angle_rad, math.log(ratio))


def _dictionary(aruco: Any, family: str) -> Any:
    names = {name.upper(): name for name in dir(aruco) if name.startswith("DICT_")}
    name = names.get("DICT_" + family.strip().upper().removeprefix("DICT_"))
    if name is None:
        known = ", ".join(sorted(name.removeprefix("DICT_") for name in names if "APRILTAG" in name))
        raise PebbleError(f"unknown tag family {family!r}; known: {known}")
    return aruco.getPredefinedDictionary(getattr(aruco, name))
