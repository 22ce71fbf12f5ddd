"""Cameras of a Raspberry Pi, through the system's own program: rpicam-vid, once called libcamera-vid.

Its output is one JPEG after the other.
"""

import shutil
import time
from typing import Final

from pebble.errors import DeviceError
from pebble.extensions.media.frames import FrameInfo
from pebble.services.av_daemon.capture_program import CaptureProgram
from pebble.services.av_daemon.config import AvDaemon
from pebble.services.av_daemon.source import Capture

_PROGRAMS = ("rpicam-vid", "libcamera-vid")
_PIPE_BYTES = 1 << 20  # what an unprivileged process may have
_START, _END = b"\xff\xd8", b"\xff\xd9"  # ISO 10918-1, table B.1
_SCAN: Final = 0xDA
_BARE = frozenset((0x01, *range(0xD0, 0xD8)))  # markers without a length: TEM and RST0 to RST7


class LibcameraCamera(CaptureProgram):
    """A camera that compresses its pictures; they are shared unchanged."""

    def __init__(self, options: AvDaemon) -> None:
        video = options.video
        super().__init__(_command(options), pipe_bytes=_PIPE_BYTES)
        self._splitter = JpegSplitter()
        self._info = FrameInfo(format="mjpeg", width=video.width, height=video.height)

    def grab(self) -> Capture:
        pictures: list[bytes] = []
        while not pictures:
            pictures = self._splitter.feed(self.read())
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


class JpegSplitter:
    """A splitter. It skips pictures longer than ``limit`` bytes, and bytes that belong to no picture."""

    def __init__(self, limit: int = 16 << 20) -> None:
        self._limit = limit
        self._buffer = bytearray()

    def feed(self, chunk: bytes) -> list[bytes]:
        """Return the pictures that ``chunk`` completes."""
        buffer, pictures = self._buffer, []
        buffer += chunk
        while True:
            start = buffer.find(_START)
            if start < 0:
                start = len(buffer)
                if buffer.endswith(_START[:1]):  # the beginning of a start, perhaps
                    start -= 1
            del buffer[:start]
            end = _end(buffer)  # 0: not known yet; -1: what begins here is no picture
            if end > 0:
                pictures.append(bytes(buffer[:end]))
            elif end == 0:  # the rest is still to come
                if len(buffer) > self._limit:
                    buffer.clear()
                return pictures
            del buffer[: end if end > 0 else 1]  # of no picture only the first byte: another may begin in it


def _end(buffer: bytearray) -> int:
    """Return the end of the first picture; 0: not yet known; -1: the bytes are no picture.

    Segments before the scan are skipped by their lengths: a preview inside them has an end marker, too.
    """
    at = len(_START)
    while at + 4 <= len(buffer):
        mark, kind = buffer[at : at + 2]
        if mark != 0xFF:
            return -1
        at += 2 if kind in _BARE else 2 + int.from_bytes(buffer[at + 2 : at + 4])
        if kind == _SCAN:
            end = buffer.find(_END, at)
            return end + len(_END) if end >= 0 else 0
    return 0
