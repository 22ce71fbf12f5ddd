"""Turns pictures, once, where they are captured: whoever reads them sees them upright."""

from __future__ import annotations

from typing import Any

import numpy as np
from msgspec.structs import replace

from pebble.errors import LinkError, PayloadError
from pebble.services.av_daemon.opencv import opencv
from pebble.services.av_daemon.source import Bytes, Capture, Source
from pebble.transports.frame_picture import picture

_BROKEN_LIMIT = 30  # pictures one after the other that cannot be decoded; a few is what bad cables do


class Rotated:
    """A camera turned clockwise by 90, 180 or 270 degrees. It gives BGR pictures, whatever the camera gives."""

    def __init__(self, camera: Source, degrees: int) -> None:
        cv2 = opencv()
        self._turns = {90: cv2.ROTATE_90_CLOCKWISE, 180: cv2.ROTATE_180, 270: cv2.ROTATE_90_COUNTERCLOCKWISE}
        self._cv2: Any = cv2
        self._camera, self._degrees = camera, degrees
        self._scratch: Bytes = np.empty(0, np.uint8)

    def grab(self) -> Capture:
        capture, upright, skipped = self._next()
        height, width = upright.shape[:2] if self._degrees == 180 else upright.shape[1::-1]

        def draw(target: Bytes) -> None:
            self._cv2.rotate(upright, self._turns[self._degrees], dst=target.reshape(height, width, 3))

        info = replace(capture.info, format="bgr24", width=width, height=height, stride=3 * width)
        return Capture(info, 3 * width * height, draw=draw, at_ns=capture.at_ns, skipped=skipped)

    def close(self) -> None:
        self._camera.close()

    def interrupt(self) -> None:
        self._camera.interrupt()

    def _next(self) -> tuple[Capture, Bytes, int]:
        """The next picture that is whole, and how many were skipped."""
        skipped = 0
        for broken in range(_BROKEN_LIMIT):
            capture = self._camera.grab()
            skipped += capture.skipped
            if len(self._scratch) < capture.size and capture.draw is not None:
                self._scratch = np.empty(capture.size, np.uint8)
            try:
                upright = picture(capture.pixels(self._scratch[: capture.size]), capture.info)
                return capture, upright, skipped + broken
            except PayloadError:
                continue
        raise LinkError(f"{_BROKEN_LIMIT} pictures one after the other cannot be decoded")
