"""Makes the picture to send from a camera's frame: decodes, scales and turns it."""

from fractions import Fraction
from typing import Any, Final

import cv2
import numpy as np

from pebble.errors import PayloadError
from pebble.extensions.media.frames.frame import Frame

Pixels = np.ndarray[Any, np.dtype[np.uint8]]

_TURNS: Final = {90: cv2.ROTATE_90_CLOCKWISE, 180: cv2.ROTATE_180, 270: cv2.ROTATE_90_COUNTERCLOCKWISE}


class Shape:
    """The shape of sent pictures. ``width``, ``height`` None: as captured, or in proportion; ``turn``: clockwise."""

    def __init__(self, width: int | None, height: int | None, turn: int) -> None:
        self._wanted = (height, width) if turn in (90, 270) else (width, height)  # before it is turned
        self._turn = turn

    def picture(self, frame: Frame, part: Fraction = Fraction(1)) -> Pixels:
        """Return the picture, BGR, at ``part`` of its size, perhaps a view of the frame. Raises PayloadError."""
        width, height = self._size(frame.info.width, frame.info.height, part)
        picture = frame.picture(width)  # if that is enough, a JPEG is decoded at 1/2, 1/4 or 1/8 size: less work
        if picture.shape[:2] != (height, width):
            how = cv2.INTER_AREA if height < picture.shape[0] else cv2.INTER_LINEAR
            picture = np.asarray(cv2.resize(picture, (width, height), interpolation=how), np.uint8)
        return np.asarray(cv2.rotate(picture, _TURNS[self._turn]), np.uint8) if self._turn else picture

    def _size(self, width: int, height: int, part: Fraction) -> tuple[int, int]:
        """Return width and height, ``part`` of the full ones, to which this size is scaled before it is turned."""
        if not (width > 0 and height > 0):
            raise PayloadError(f"a picture of {width}x{height} pixels")
        wanted_width, wanted_height = self._wanted
        if wanted_width is not None and wanted_height is not None:
            return _scaled(wanted_width, part), _scaled(wanted_height, part)
        if wanted_height is not None:
            wanted_width = round(width * wanted_height / height)
        across = _scaled(wanted_width or width, part)
        return across, max(1, round(height * across / width))


def _scaled(length: int, part: Fraction) -> int:
    return max(1, round(length * part))
