"""Cameras of a Raspberry Pi, through the system's own program: rpicam-vid, once called libcamera-vid."""

from __future__ import annotations

import shutil
import time
from typing import Any

import numpy as np

from pebble.config.media import AvDaemon
from pebble.errors import DeviceError
from pebble.services.av_daemon.capture_program import CaptureProgram
from pebble.services.av_daemon.jpeg_splitter import JpegSplitter
from pebble.services.av_daemon.source import Bytes, Capture, opencv
from pebble.transports.frames import FrameInfo

_PROGRAMS = ("rpicam-vid", "libcamera-vid")
_PIPE_BYTES = 1 << 20  # what an unprivileged process may have
_ROW_UNIT = 64  # pixels; rows of other lengths are padded in raw output, by how much depends on the camera


def open_libcamera(options: AvDaemon) -> JpegCamera | RawCamera:
    """The camera as configured: JPEG pictures as they are, unless ``capture_format`` is raw."""
    if options.video.capture_format in ("auto", "mjpeg"):
        return JpegCamera(options)
    if options.video.capture_format in ("raw", "yuv420"):
        return RawCamera(options)
    raise DeviceError(f'libcamera has no capture_format "{options.video.capture_format}": use auto, mjpeg or raw')


class JpegCamera:
    """Pictures as the camera compressed them."""

    def __init__(self, options: AvDaemon) -> None:
        video = options.video
        self._program = _start(options, "mjpeg")
        self._splitter = JpegSplitter()
        self._info = FrameInfo(format="mjpeg", width=video.width, height=video.height)

    def grab(self) -> Capture:
        pictures: list[bytes] = []
        while not pictures:
            pictures = self._splitter.feed(self._program.read())
        newest = pictures[-1]
        return Capture(self._info, len(newest), newest, at_ns=time.monotonic_ns(), skipped=len(pictures) - 1)

    def close(self) -> None:
        self._program.close()

    def interrupt(self) -> None:
        self._program.interrupt()


class RawCamera:
    """BGR pictures made of the camera's planes: more bytes and more work, no loss."""

    def __init__(self, options: AvDaemon) -> None:
        video = options.video
        if video.width % _ROW_UNIT or video.height % 2:
            raise DeviceError(f"raw libcamera pictures must be a multiple of {_ROW_UNIT} wide and of 2 high")
        self._cv2: Any = opencv()
        self._width, self._height = video.width, video.height
        self._size = video.width * video.height * 3 // 2
        self._program = _start(options, "yuv420")
        self._buffer = bytearray()
        self._info = FrameInfo(format="bgr24", width=video.width, height=video.height, stride=3 * video.width)

    def grab(self) -> Capture:
        while len(self._buffer) < self._size:
            self._buffer += self._program.read()
        complete = len(self._buffer) // self._size
        end = complete * self._size
        newest = np.frombuffer(bytes(self._buffer[end - self._size : end]), np.uint8)
        del self._buffer[:end]
        planes = newest.reshape(self._height * 3 // 2, self._width)

        def draw(target: Bytes) -> None:
            picture = target.reshape(self._height, self._width, 3)
            self._cv2.cvtColor(planes, self._cv2.COLOR_YUV2BGR_I420, dst=picture)

        size = self._width * self._height * 3
        return Capture(self._info, size, draw=draw, at_ns=time.monotonic_ns(), skipped=complete - 1)

    def close(self) -> None:
        self._program.close()

    def interrupt(self) -> None:
        self._program.interrupt()


def _start(options: AvDaemon, codec: str) -> CaptureProgram:
    video = options.video
    program = next((name for name in _PROGRAMS if shutil.which(name)), None)
    if program is None:
        raise DeviceError("neither rpicam-vid nor libcamera-vid is installed: sudo apt install rpicam-apps")
    command = [
        program, "--nopreview", "--verbose", "0", "--timeout", "0", "--flush", "--codec", codec,
        "--width", str(video.width), "--height", str(video.height), "--framerate", f"{video.fps:g}", "--output", "-",
    ]  # fmt: skip
    if video.camera_name is not None:
        command += ["--camera", video.camera_name]
    for name, value in video.camera_controls.items():
        command += [f"--{name}"] if value is True else [f"--{name}", str(value)]
    return CaptureProgram(command, pipe_bytes=_PIPE_BYTES)
