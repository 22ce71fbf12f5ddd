"""Checks a JPEG before it is decoded, so that half a picture is never shown as a whole one."""

import re
from typing import Final, TypeAlias, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from pebble.errors import PayloadError

#: More than any camera of a robot needs: bytes of one picture, and pixels along an edge.
MAX_BYTES: Final = 8 << 20
MAX_EDGE: Final = 4096

SOI: Final = b"\xff\xd8"
_MAX_SEGMENTS: Final = 256
_MAX_SCANS: Final = 32  # progressive pictures have about ten; each costs a pass over the whole picture
_MAX_FILL: Final = 64
_SIZES: Final = (0xC0, 0xC1, 0xC2)  # SOF of baseline, extended and progressive Huffman: what libjpeg decodes everywhere
_SEQUENTIAL: Final = (0xC0, 0xC1)
_DHT, _JPG, _DAC, _EOI, _SOS, _TEM = 0xC4, 0xC8, 0xCC, 0xD9, 0xDA, 0x01
#: Ends a scan: FF and neither a stuffed zero nor a restart marker (ITU-T T.81, B.1.1.5). More FF before it are padding.
_end_of_scan = re.compile(rb"\xff[^\x00\xd0-\xd7]", re.DOTALL).search

Pixels: TypeAlias = NDArray[np.uint8]


def decode_jpeg(jpeg: bytes) -> Pixels:
    """BGR, shape (height, width, 3), the caller's own. Raises PayloadError unless it is a whole picture.

    Bits flipped within the coefficients go undetected: JPEG has no checksum; TCP and zlib have.
    """
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
    """Width and height of a complete JPEG; PayloadError if it is too large, no JPEG, or has no proper end.

    libjpeg fills what is missing with grey and calls it a picture. An end marker cannot occur within a scan (FF is
    stuffed there), so walking over the segments to the end marker distinguishes a whole picture from a part of one.
    """
    if len(jpeg) > MAX_BYTES:
        raise PayloadError(f"JPEG: {len(jpeg)} bytes, more than {MAX_BYTES}")
    if not jpeg.startswith(SOI):
        raise PayloadError("JPEG: no start marker")
    return _Segments(jpeg).size()


class _Segments:
    """Walks from one marker to the next."""

    def __init__(self, jpeg: bytes) -> None:
        self._jpeg = jpeg
        self._at = len(SOI)
        self._frame = 0  # which SOF
        self._size = (0, 0)
        self._blocks = 0  # of 8×8 coefficients in the whole picture
        self._scans = 0
        self._scanned = 0  # bytes in scans

    def size(self) -> tuple[int, int]:
        for _ in range(_MAX_SEGMENTS):
            marker = self._marker()
            if marker == _EOI:
                return self._whole()
            body = self._segment()
            if marker in _SIZES:
                self._start_of_frame(marker, body)
            elif 0xC0 <= marker <= 0xCF and marker not in (_DHT, _JPG, _DAC):
                raise PayloadError("JPEG: of an unsupported kind")
            elif marker == _SOS:
                self._scan()
        raise PayloadError("JPEG: too many segments")

    def _marker(self) -> int:
        jpeg, at = self._jpeg, self._at
        if jpeg[at : at + 1] != b"\xff":
            raise PayloadError("JPEG: cut short, or no marker where one has to be")
        fill = at + _MAX_FILL
        while jpeg[at : at + 1] == b"\xff" and at < fill:
            at += 1
        self._at = at + 1
        marker = jpeg[at] if at < len(jpeg) else 0
        if marker <= _TEM or 0xD0 <= marker <= 0xD8 or marker == 0xFF:
            raise PayloadError("JPEG: cut short, or a marker where none may be")
        return marker

    def _segment(self) -> bytes:
        jpeg, at = self._jpeg, self._at
        length = int.from_bytes(jpeg[at : at + 2], "big")
        self._at = at + length
        if length < 2 or self._at > len(jpeg):
            raise PayloadError("JPEG: cut short in a segment")
        return jpeg[at + 2 : self._at]

    def _start_of_frame(self, marker: int, body: bytes) -> None:
        if self._frame:
            raise PayloadError("JPEG: two pictures in one")
        if len(body) < 6 or body[0] != 8 or body[5] not in (1, 3) or len(body) != 6 + 3 * body[5]:
            raise PayloadError("JPEG: neither grey nor colour of 8 bits")
        height, width = int.from_bytes(body[1:3], "big"), int.from_bytes(body[3:5], "big")
        if not (0 < width <= MAX_EDGE and 0 < height <= MAX_EDGE):
            raise PayloadError(f"JPEG: {width}x{height}, larger than {MAX_EDGE}x{MAX_EDGE} or nothing")
        self._frame, self._size = marker, (width, height)
        factors = [(sampling >> 4, sampling & 15) for sampling in body[7::3]]
        if not all(1 <= across <= 4 and 1 <= down <= 4 for across, down in factors):
            raise PayloadError("JPEG: impossible sampling")
        most_across, most_down = max(across for across, _ in factors), max(down for _, down in factors)
        self._blocks = sum(
            _eighths(width * across, most_across) * _eighths(height * down, most_down) for across, down in factors
        )

    def _scan(self) -> None:
        self._scans += 1
        if not self._frame or self._scans > _MAX_SCANS:
            raise PayloadError("JPEG: a scan without a picture, or too many")
        end = _end_of_scan(self._jpeg, self._at)
        if end is None:
            raise PayloadError("JPEG: cut short in its picture")
        self._scanned += end.start() - self._at
        self._at = end.start()

    def _whole(self) -> tuple[int, int]:
        if not self._scans:
            raise PayloadError("JPEG: without a picture")
        # A block takes at least two codes of a bit each, so a scan that is shorter ends before its picture does.
        if self._frame in _SEQUENTIAL and self._scanned * 4 < self._blocks:
            raise PayloadError("JPEG: fewer bytes than a picture of this size takes")
        return self._size


def _eighths(samples: int, divisor: int) -> int:
    """How many blocks of eight hold ``samples / divisor`` samples."""
    return -(-samples // (8 * divisor))
