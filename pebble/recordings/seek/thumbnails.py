"""Single pictures of a recording as JPEGs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

from pebble.errors import PebbleError
from pebble.media import pyav
from pebble.recordings.seek.archive import Archive

if TYPE_CHECKING:
    from pebble.media.jpeg import Pixels

WIDEST: Final = 1920
MOST: Final = 24  # thumbnails of a strip
OLDEST_NS: Final = 10 * 10**9  # a picture stands for so long after it
_QUALITY, _SMALL_QUALITY = 85, 70
_SMALL: Final = 480  # pixels; pictures up to here are thumbnails
_GREY: Final = 96


class Frame(NamedTuple):
    """One picture."""

    jpeg: bytes
    captured_ms: float  # by its robot's clock; else when it was received
    received_ms: float


def frame(archive: Archive, robot: str, at_ms: float, width: int = 0) -> Frame | None:
    """The last picture at that time, ``width`` pixels wide (0: as it is); None if none is there, or it is old.

    Raises PebbleError without the packages that decode it.
    """
    picture = _picture(archive, robot, round(at_ms * 1e6) + 1, keyframe_only=False)
    if picture is None:
        return None
    pixels, captured_ms, received_ms = picture
    return Frame(_encode(_narrowed(pixels, width)), captured_ms, received_ms)


def strip(archive: Archive, robot: str, since_ms: float, step_ms: float, count: int, width: int) -> bytes:
    """Thumbnails side by side, of key frames, one for each step; grey where there is none."""
    import cv2
    import numpy as np

    height = width * 9 // 16
    whole: Any = np.full((height, width * count, 3), _GREY, np.uint8)
    for number in range(count):
        at_ns = round((since_ms + (number + 1) * step_ms) * 1e6)
        oldest_ns = max(OLDEST_NS, round(step_ms * 1e6))
        picture = _picture(archive, robot, at_ns, keyframe_only=True, oldest_ns=oldest_ns)
        if picture is not None:
            small: Any = cv2.resize(picture[0], (width, height), interpolation=cv2.INTER_AREA)
            whole[:, number * width : (number + 1) * width] = small
    return _encode(whole)


def _picture(
    archive: Archive, robot: str, before_ns: int, *, keyframe_only: bool, oldest_ns: int = OLDEST_NS
) -> tuple[Pixels, float, float] | None:
    """Pixels, and epoch milliseconds when they were captured and received."""
    try:
        from pebble.media.decode import VideoDecoder
    except ImportError:
        raise PebbleError('pictures need packages: pip install "pebble-robot[media]"') from None
    decoder, newest = VideoDecoder(), None
    chain = archive.pictures(robot, before_ns, keyframe_only=keyframe_only)
    if not chain or chain[-1].log_ns < before_ns - oldest_ns:
        return None
    for one in chain:
        decoded = decoder.feed(one.payload)
        newest = newest if decoded is None else (decoded, one)
    if newest is None:
        if not pyav.installed():
            raise PebbleError(f"these pictures may be H.264: this server {pyav.INSTALL}")
        return None
    picture, one = newest
    received_ms = one.log_ns / 1e6
    return picture.picture, float(picture.captured_ms or received_ms), received_ms


def _narrowed(picture: Any, width: int) -> Any:
    import cv2

    height, wide = picture.shape[:2]
    if not 0 < width < wide:
        return picture
    return cv2.resize(picture, (width, max(1, height * width // wide)), interpolation=cv2.INTER_AREA)


def _encode(picture: Any) -> bytes:
    import cv2

    quality = _SMALL_QUALITY if picture.shape[1] <= _SMALL else _QUALITY
    encoded: bytes = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
    return encoded
