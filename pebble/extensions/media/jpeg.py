"""Checks a JPEG before it is decoded, so that a part of a picture is never shown as a whole one."""

from typing import Final, TypeAlias, cast

import numpy as np
from numpy.typing import NDArray

from pebble.errors import PayloadError

#: More than any camera of a robot needs: bytes of one picture, and pixels along an edge.
MAX_BYTES: Final = 8 << 20
MAX_EDGE: Final = 4096  # pixels

SOI: Final = b"\xff\xd8"
_EOI: Final = b"\xff\xd9"
SCAN: Final = b"\xff\xda"
_MAX_SCANS: Final = 32  # progressive pictures have about ten; each costs a pass over the whole picture
_SIZES: Final = (0xC0, 0xC1, 0xC2)  # SOF of baseline, extended and progressive Huffman: what libjpeg decodes everywhere

Pixels: TypeAlias = NDArray[np.uint8]


def decode_jpeg(jpeg: bytes) -> Pixels:
    """Return a whole picture as a new array: BGR, (height, width, 3). Raises PayloadError for anything else.

    Bits flipped within the coefficients go undetected: JPEG has no checksum; TCP and zlib have.
    """
    import cv2  # late: it takes 16 MB, and `jpeg_size` does without it

    width, height = jpeg_size(jpeg)
    # The picture as it was sent: turned as EXIF says, it would not fit the differences that follow.
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        pixels = cv2.imdecode(np.frombuffer(jpeg, np.uint8), flags)
    except cv2.error as error:
        raise PayloadError(f"JPEG: {error}") from None
    if pixels is None or pixels.shape != (height, width, 3):
        raise PayloadError("JPEG: libjpeg refuses it")
    return cast(Pixels, pixels)


def jpeg_size(jpeg: bytes) -> tuple[int, int]:
    """Return the width and height of a JPEG. Raises PayloadError if it is too large, is no JPEG or has no end.

    libjpeg fills missing parts with grey and reports a picture. An end marker cannot occur within a scan (FF is stuffed
    there), so an end marker after the size shows that the picture is whole.
    """
    if len(jpeg) > MAX_BYTES:
        raise PayloadError(f"JPEG: {len(jpeg)} bytes, more than {MAX_BYTES}")
    if not jpeg.startswith(SOI):
        raise PayloadError("JPEG: no start marker")
    at = len(SOI)
    while jpeg[at : at + 1] == b"\xff" and at + 9 <= len(jpeg):
        marker, length = jpeg[at + 1], int.from_bytes(jpeg[at + 2 : at + 4], "big")
        if marker in _SIZES:
            height, width = int.from_bytes(jpeg[at + 5 : at + 7], "big"), int.from_bytes(jpeg[at + 7 : at + 9], "big")
            _check(jpeg, at, width, height)
            return width, height
        at += 1 if marker == 0xFF else 2 + length  # more FF before a marker are padding
    raise PayloadError("JPEG: cut short, or of an unsupported kind")


def _check(jpeg: bytes, frame: int, width: int, height: int) -> None:
    """Raise PayloadError unless the picture is whole and within the limits. ``frame``: offset of its frame header."""
    if not (0 < width <= MAX_EDGE and 0 < height <= MAX_EDGE):
        raise PayloadError(f"JPEG: {width}x{height}, larger than {MAX_EDGE}x{MAX_EDGE} or nothing")
    if jpeg.find(_EOI, frame) < 0:
        raise PayloadError("JPEG: cut short")
    if jpeg.count(SCAN) > _MAX_SCANS:
        raise PayloadError("JPEG: too many scans")
