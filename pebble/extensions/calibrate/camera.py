"""Calibrates a camera by pictures of one tag, held in all parts of the picture, near and far."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pebble.errors import PebbleError
from pebble.extensions.calibrate.wheels import Person
from pebble.extensions.scripts.perception.camera_model import Floats
from pebble.extensions.scripts.perception.tags import Tag, TagFinder, largest
from pebble.runtime.as_owner import as_owner
from pebble.runtime.whole_file import write

LEAST_PICTURES = 15
LEAST_SHARE = 0.01  # of the picture that the tag fills
WORST_PX = 1.0
_NEAR, _MIDDLE = 0.08, 0.03  # shares of the picture from which the tag is near, or in between
_STILL_PX = 1.0  # a corner moves less from picture to picture: the tag rests
_STILL_PICTURES = 3
_ROWS, _COLUMNS, _DISTANCES = ("top", "middle", "bottom"), ("left", "centre", "right"), ("near", "between", "far")

View = tuple[str, str, str]  # a row, a column and a distance, in which the tag is


class Lens(NamedTuple):
    """A calibrated camera, for pictures of ``size`` (width, height)."""

    matrix: Floats
    distortion: Floats
    size: tuple[int, int]
    error_px: float
    pictures: int


def view_of(tag: Tag, size: tuple[int, int]) -> View | None:
    """Return the place of a tag in a picture of this size; None if the tag is too small in it."""
    width, height = size
    share = tag.area / (width * height)
    if share < LEAST_SHARE:
        return None
    x, y = tag.corners.mean(axis=0)
    near, between, far = _DISTANCES
    if share >= _NEAR:
        distance = near
    elif share >= _MIDDLE:
        distance = between
    else:
        distance = far
    return _ROWS[int(3 * y / height)], _COLUMNS[int(3 * x / width)], distance


def collect(
    pictures: Iterable[Any], finder: TagFinder, tag_id: int, person: Person, *, still: bool
) -> tuple[list[Floats], tuple[int, int]]:
    """Return the corners of the tag in up to 27 different places, and the width and height of the pictures.

    ``still``: photos, which all count. In a stream the tag must be at rest, and 15 well-spread places are enough.
    """
    by_view: dict[View, Floats] = {}
    size, resting = (0, 0), 0  # resting: pictures in a row in which the tag rests
    before: Floats | None = None  # the tag's corners in the last picture
    for picture in pictures:
        size = picture.shape[1], picture.shape[0]
        tag = largest(finder.find(picture), tag_id)
        if tag is None:
            before = None
            continue
        rests = before is not None and float(np.abs(tag.corners - before).max()) < _STILL_PX
        resting = resting + 1 if rests else 0
        before = tag.corners
        view = view_of(tag, size) if still or resting >= _STILL_PICTURES else None
        if view is None or view in by_view:
            continue
        by_view[view] = tag.corners
        seen = {word for known_view in by_view for word in known_view}
        missing = [name for name in (*_ROWS, *_COLUMNS, *_DISTANCES) if name not in seen]
        person.tell(
            f"{len(by_view)} of {LEAST_PICTURES}: {' '.join(view)}; next: {', '.join(missing) or 'another place'}"
        )
        if not still and len(by_view) >= LEAST_PICTURES and not missing:
            break
    return list(by_view.values()), size


def solve(corners: list[Floats], size: tuple[int, int], size_m: float) -> Lens:
    """Return the calibrated camera. Raises PebbleError for too few pictures, or an error of more than a pixel."""
    import cv2

    if len(corners) < LEAST_PICTURES:
        raise PebbleError(f"{len(corners)} pictures of the tag in different places: {LEAST_PICTURES} are needed")
    half = size_m / 2
    square = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]], np.float32)
    points = [four.astype(np.float32).reshape(4, 1, 2) for four in corners]
    flags = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST  # four corners a picture do not show more
    solved: Any = cv2.calibrateCamera([square] * len(points), points, size, None, None, flags=flags)
    error, matrix, distortion = solved[:3]
    if not error <= WORST_PX:
        why = f"the pictures fit to {error:.2f} pixels only, more than {WORST_PX:g}"
        raise PebbleError(f"{why}: hold the tag flat and still, and begin again")
    return Lens(np.asarray(matrix, float), np.asarray(distortion, float).ravel(), size, float(error), len(corners))


def save(path: Path, lens: Lens, tag_id: int, size_m: float, family: str) -> None:
    """Write the calibration with the keys of the original's program. Raises PebbleError."""
    import cv2

    file = cv2.FileStorage(".yaml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    values: dict[str, Any] = {
        "image_width": lens.size[0],
        "image_height": lens.size[1],
        "camera_matrix": lens.matrix,
        "distortion_coefficients": lens.distortion.reshape(1, -1),
        "reprojection_error": lens.error_px,
        "marker_dictionary": family,
        "marker_id": tag_id,
        "marker_size": size_m,
        "num_samples": lens.pictures,
    }
    for key, value in values.items():
        file.write(key, value)
    with as_owner(path.parent):
        write(path, file.releaseAndGetString().encode(), 0o644, PebbleError)


def read_folder(folder: Path) -> Iterator[Any]:
    """Yield the pictures of a folder in the order of their names. PebbleError for none, or different sizes."""
    import cv2

    shape: tuple[int, ...] | None = None
    for path in sorted(folder.glob("*")):
        picture = cv2.imread(str(path))
        if picture is None:
            continue
        if shape not in (None, picture.shape):
            raise PebbleError(
                f"{path}: it is {picture.shape[1]} pixels wide and {picture.shape[0]} high, unlike the others"
            )
        shape = picture.shape
        yield picture
    if shape is None:
        raise PebbleError(f"{folder}: there is no picture")


def tape_line(lens: Lens, size_m: float) -> str:
    """Return a sentence that tells how to check the calibration with a tape measure."""
    wide = lens.matrix[0, 0] * size_m
    return f"check it: where the black square is {wide:.0f} pixels wide, a tape from the lens to it reads 1.00 m"
