"""Video as JPEGs: full pictures, and between them differences from what the receiver has decoded (paper 8.8)."""

from typing import Final, NamedTuple, cast

import cv2

from pebble.media.jpeg import Pixels, decode_jpeg

GREY: Final = 128  # of a difference of nothing


class CodedPicture(NamedTuple):
    jpeg: bytes
    keyframe: bool


def subtract(picture: Pixels, reference: Pixels, out: Pixels | None = None) -> Pixels:
    """``clip(picture - reference + 128)``; sums of bytes are exact in cv2's floats."""
    return cast(Pixels, cv2.addWeighted(picture, 1, reference, -1, GREY, out))


def add(reference: Pixels, difference: Pixels, out: Pixels | None = None) -> Pixels:
    """``clip(reference + difference - 128)``: what a receiver does. ``out`` may be ``reference``."""
    return cast(Pixels, cv2.addWeighted(reference, 1, difference, 1, -GREY, out))


class JpegDelta:
    """Encodes pictures one after the other.

    It decodes its own JPEGs, so a difference also corrects the errors of the one before. (Differences from the camera's
    previous picture, as the paper's first encoder made them, add the errors up until the next full picture.)
    ``quality`` (1..100) and ``interval`` (pictures from one full picture to the next) may change at any time.
    ``optimize``: Huffman tables made for each picture; at low quality a quarter smaller, for 0.4 ms more at 640x480.
    """

    def __init__(self, *, interval: int, quality: float, optimize: bool = True) -> None:
        self.interval = interval
        self.quality = quality
        self._optimize = int(optimize)
        self._since_keyframe = 0
        self._chained = False  # does the receiver have what ``_reference`` holds?
        self._reference: Pixels | None = None
        self._difference: Pixels | None = None

    def code(self, picture: Pixels, *, keyframe: bool = False) -> CodedPicture:
        """``picture``: BGR, (height, width, 3). Another size than before makes a full picture by itself."""
        reference = self._reference if self._chained else None
        if keyframe or reference is None or reference.shape != picture.shape:
            self._since_keyframe = 0
            jpeg = self._jpeg(picture)
            if self._is_reference():
                self._reference = decode_jpeg(jpeg)
            return CodedPicture(jpeg, True)
        self._since_keyframe += 1
        self._difference = subtract(picture, reference, self._fitting(self._difference, picture))
        jpeg = self._jpeg(self._difference)
        if self._is_reference():
            add(reference, decode_jpeg(jpeg), reference)
        return CodedPicture(jpeg, False)

    def _is_reference(self) -> bool:
        """Will anything build on this picture? Not if the next one is full."""
        self._chained = self._since_keyframe + 1 < self.interval
        return self._chained

    def _jpeg(self, picture: Pixels) -> bytes:
        quality = round(min(100, max(1, self.quality)))
        options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_OPTIMIZE, self._optimize]
        return cv2.imencode(".jpg", picture, options)[1].tobytes()

    @staticmethod
    def _fitting(buffer: Pixels | None, picture: Pixels) -> Pixels | None:
        return buffer if buffer is not None and buffer.shape == picture.shape else None
