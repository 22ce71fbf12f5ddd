"""Cameras of a Raspberry Pi, through the system's own program: rpicam-vid, once called libcamera-vid."""

import logging
import shutil
import time

from pebble.errors import DeviceError
from pebble.extensions.media.frames import FrameInfo
from pebble.services.av_daemon.capture_program import SILENCE_S, CaptureProgram
from pebble.services.av_daemon.config import AvDaemon
from pebble.services.av_daemon.jpeg_splitter import JpegSplitter
from pebble.services.av_daemon.source import Capture

log = logging.getLogger(__name__)

_PROGRAMS = ("rpicam-vid", "libcamera-vid")
_PIPE_BYTES = 1 << 20  # what an unprivileged process may have


class LibcameraCamera(CaptureProgram):
    """A camera that compresses its pictures; they are shared unchanged."""

    def __init__(self, options: AvDaemon) -> None:
        video = options.video
        if video.capture_format not in ("auto", "mjpeg"):
            log.warning("libcamera sends mjpeg: capture_format %s does nothing", video.capture_format)
        super().__init__(_command(options), pipe_bytes=_PIPE_BYTES)
        self._splitter = JpegSplitter()
        self._info = FrameInfo(format="mjpeg", width=video.width, height=video.height)

    def grab(self) -> Capture:
        pictures: list[bytes] = []
        until: float | None = None  # from the first bytes on
        while not pictures:
            pictures = self._splitter.feed(self.read())
            now = time.monotonic()
            until = now + SILENCE_S if until is None else until
            if not pictures and now > until:
                raise DeviceError(f"{self.name} writes no whole JPEG: is it the camera's own program?")
        newest = pictures[-1]
        return Capture(self._info, len(newest), newest, at_ns=time.monotonic_ns(), skipped=len(pictures) - 1)


def _command(options: AvDaemon) -> list[str]:
    """Return the program with its arguments. Raises DeviceError if none is installed."""
    video = options.video
    program = next((name for name in _PROGRAMS if shutil.which(name)), None)
    if program is None:
        raise DeviceError("neither rpicam-vid nor libcamera-vid is installed: sudo apt install rpicam-apps")
    command = [
        program, "--nopreview", "--verbose", "0", "--timeout", "0", "--flush", "--codec", "mjpeg",
        "--width", str(video.width), "--height", str(video.height), "--framerate", f"{video.fps:g}", "--output", "-",
    ]  # fmt: skip
    if video.camera_name is not None:
        command += ["--camera", video.camera_name]
    for name, value in video.camera_controls.items():
        command += [f"--{name}"] if value is True else [f"--{name}", str(value)]
    return command
