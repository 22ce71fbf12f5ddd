"""Opens the camera and the microphone of a config, also a camera that is mounted at an angle."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, TypeAlias

import numpy as np
from msgspec.structs import replace

from pebble.errors import DeviceError, PayloadError
from pebble.extensions.media.frames.frame import picture
from pebble.services.av_daemon.alsa import CHUNK_S, AlsaMicrophone
from pebble.services.av_daemon.config import AvDaemon, CameraCapture, Microphone
from pebble.services.av_daemon.health import Asked
from pebble.services.av_daemon.libcamera import LibcameraCamera
from pebble.services.av_daemon.source import Bytes, Capture, Source, opencv
from pebble.services.av_daemon.synthetic import SyntheticCamera, SyntheticMicrophone, WorldCamera
from pebble.services.av_daemon.v4l2 import V4l2Camera, is_device

Opener: TypeAlias = Callable[[], Source]

_LIBCAMERA: Final = ("libcamera", "arducam", "picamera2")  # three names of one backend
_BROKEN_LIMIT = 30  # pictures one after the other that cannot be decoded; a few is what bad cables do


def camera(options: AvDaemon, start: float) -> Opener:
    """Return a function that opens the camera, upright.

    ``start``: the time at which a synthetic camera begins to count, monotonic.
    """

    def open_() -> Source:
        degrees = options.video.rotate_degrees
        device = _camera(options, start)
        return Rotated(device, degrees) if degrees else device

    return open_


def microphone(options: AvDaemon, start: float) -> Opener:
    if options.audio.source == "synthetic":
        return lambda: SyntheticMicrophone(options.audio, start)
    return lambda: AlsaMicrophone(options)


def asked_of_camera(video: CameraCapture) -> Asked | None:
    """Return the rate and size that a camera is asked for; None for a synthetic camera.

    For a file or a network stream, which cannot be asked, it is ``Asked()``: any rate and size.
    """
    if video.backend == "synthetic":
        return None
    if video.backend == "v4l2" and not is_device(video.device):
        return Asked()
    width, height = (video.height, video.width) if video.rotate_degrees % 180 else (video.width, video.height)
    return Asked(video.fps, width, height)


def asked_of_microphone(audio: Microphone) -> Asked | None:
    return None if audio.source == "synthetic" else Asked(1 / CHUNK_S)


def picture_bytes(options: AvDaemon) -> int:
    video = options.video
    pixels = video.width * video.height
    compressed = video.backend in _LIBCAMERA and not video.rotate_degrees
    return pixels if compressed else 3 * pixels  # no camera needs 8 bits per pixel for a JPEG


def chunk_bytes(options: AvDaemon) -> int:
    """Return the number of bytes in a piece of sound."""
    return round(options.audio.rate * CHUNK_S) * 2 * options.audio.channels


def _camera(options: AvDaemon, start: float) -> Source:
    if options.video.backend == "synthetic" and "#" in options.video.device:  # world.json#goob: a robot in a world
        return WorldCamera(options.video, start)
    if options.video.backend == "synthetic":
        return SyntheticCamera(options.video, start)
    if options.video.backend in _LIBCAMERA:
        return LibcameraCamera(options)
    return V4l2Camera(options.video)


class Rotated:
    """A camera whose pictures are turned clockwise by 90, 180 or 270 degrees, once for all readers; they are BGR."""

    def __init__(self, camera: Source, degrees: int) -> None:
        cv2 = opencv()
        self._turns = {90: cv2.ROTATE_90_CLOCKWISE, 180: cv2.ROTATE_180, 270: cv2.ROTATE_90_COUNTERCLOCKWISE}
        self._cv2: Any = cv2
        self._camera, self._degrees = camera, degrees
        self._scratch: Bytes = np.empty(0, np.uint8)  # room for a picture before it is turned

    def grab(self) -> Capture:
        capture, original, skipped = self._next()
        height, width = original.shape[:2]
        if self._degrees != 180:
            height, width = width, height

        def draw(target: Bytes) -> None:
            self._cv2.rotate(original, self._turns[self._degrees], dst=target.reshape(height, width, 3))

        info = replace(capture.info, format="bgr24", width=width, height=height, stride=3 * width)
        return Capture(info, 3 * width * height, draw=draw, at_ns=capture.at_ns, skipped=skipped)

    def close(self) -> None:
        self._camera.close()

    def interrupt(self) -> None:
        self._camera.interrupt()

    def _next(self) -> tuple[Capture, Bytes, int]:
        """Return the next whole picture, and how many broken ones were skipped."""
        skipped = 0
        for broken in range(_BROKEN_LIMIT):
            capture = self._camera.grab()
            skipped += capture.skipped
            if len(self._scratch) < capture.size and capture.draw is not None:  # without `draw` it has its data
                self._scratch = np.empty(capture.size, np.uint8)
            try:
                original = picture(capture.pixels(self._scratch[: capture.size]), capture.info)
                return capture, original, skipped + broken
            except PayloadError:
                continue
        raise DeviceError(f"{_BROKEN_LIMIT} pictures one after the other cannot be decoded")
