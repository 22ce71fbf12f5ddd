"""Which camera and which microphone a config means."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, TypeAlias

from pebble.config.later import AvDaemon
from pebble.services.av_daemon.alsa import CHUNK_S, AlsaMicrophone
from pebble.services.av_daemon.libcamera import open_libcamera
from pebble.services.av_daemon.rotation import Rotated
from pebble.services.av_daemon.source import Source
from pebble.services.av_daemon.synthetic import SyntheticCamera, SyntheticMicrophone
from pebble.services.av_daemon.v4l2 import V4l2Camera

Opener: TypeAlias = Callable[[], Source]

_LIBCAMERA: Final = ("libcamera", "arducam", "picamera2")  # three names of one way


def camera(options: AvDaemon, start: float) -> Opener:
    """What opens the camera, upright. ``start``: when a synthetic one began to count, on ``time.monotonic()``."""

    def open_() -> Source:
        degrees = options.video.rotate_degrees
        device = _camera(options, start)
        return Rotated(device, degrees) if degrees else device

    return open_


def microphone(options: AvDaemon, start: float) -> Opener:
    """What opens the microphone."""
    if options.audio.source == "synthetic":
        return lambda: SyntheticMicrophone(options.audio, start)
    return lambda: AlsaMicrophone(options)


def picture_bytes(options: AvDaemon) -> int:
    """Room for the largest picture."""
    video = options.video
    pixels = video.width * video.height
    compressed = video.backend in _LIBCAMERA and video.capture_format in ("auto", "mjpeg") and not video.rotate_degrees
    return pixels if compressed else 3 * pixels  # no camera needs 8 bits per pixel for a JPEG


def chunk_bytes(options: AvDaemon) -> int:
    """The size of one piece of sound."""
    return round(options.audio.rate * CHUNK_S) * 2 * options.audio.channels


def _camera(options: AvDaemon, start: float) -> Source:
    if options.video.backend == "synthetic":
        return SyntheticCamera(options.video, start)
    if options.video.backend in _LIBCAMERA:
        return open_libcamera(options)
    return V4l2Camera(options.video)
