"""Cameras of the Linux kernel (V4L2), and files and network streams in place of a camera, through OpenCV."""

import logging
import os
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pebble.errors import DeviceError
from pebble.extensions.media.frames import FrameInfo
from pebble.services.av_daemon.capture_program import SILENCE_S
from pebble.services.av_daemon.config import CameraCapture
from pebble.services.av_daemon.source import Bytes, Capture, opencv

log = logging.getLogger(__name__)

_FOURCC = {"mjpeg": "MJPG", "yuyv": "YUYV", "raw": "YUYV"}  # V4L2's name; others are its names already
_PASSED_ON = {"MJPG": "mjpeg", "YUYV": "yuyv"}  # frames that may travel as the camera made them


class V4l2Camera:
    """A camera by the name of its device. Its MJPEG is shared unchanged, unless ``capture_format`` is ``raw``.

    A read that hangs cannot be interrupted; OpenCV's timeout ends it after 3 s.
    """

    def __init__(self, video: CameraCapture) -> None:
        os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", f"{SILENCE_S:.0f}")  # seconds; else 10
        self._cv2: Any = opencv()
        self._device = video.device
        self._name = _without_secrets(self._device)
        self._capture = self._open(video)
        try:
            self._format = self._choose_format(video)
            self._info = self._first_picture()  # shows what the camera really sends
        except DeviceError:
            self.close()
            raise

    def grab(self) -> Capture:
        self._wait()
        at_ns = time.monotonic_ns()
        if self._info.format == "bgr24":
            return Capture(self._info, self._info.stride * self._info.height, draw=self._draw, at_ns=at_ns)
        data = self._retrieve().reshape(-1)
        return Capture(self._info, data.size, data, at_ns=at_ns)

    def close(self) -> None:
        self._capture.release()

    def interrupt(self) -> None:
        """Do nothing: OpenCV has no safe way while another thread reads."""

    def _open(self, video: CameraCapture) -> Any:
        cv2, device = self._cv2, self._device
        name = int(device) if device.isdecimal() else device
        capture = cv2.VideoCapture(name, cv2.CAP_V4L2 if is_device(device) else cv2.CAP_ANY)
        if not capture.isOpened():
            raise DeviceError(f"cannot open {self._name}: not there, in use, or no camera")
        if video.capture_format != "auto":
            fourcc = _FOURCC.get(video.capture_format, video.capture_format.upper())
            capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*f"{fourcc:4.4}"))  # it takes four characters
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, video.width)
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, video.height)
        capture.set(cv2.CAP_PROP_FPS, video.fps)
        for control, value in video.camera_controls.items():
            prop = getattr(cv2, f"CAP_PROP_{control.upper()}", None)
            if prop is None or not isinstance(value, int | float) or not capture.set(prop, float(value)):
                log.warning("%s does not take camera_controls.%s = %s", self._name, control, value)
        return capture

    def _choose_format(self, video: CameraCapture) -> str:
        """Return the frames' format: the camera's own if readers can decode it and OpenCV passes it unchanged."""
        if self._capture.getBackendName() != "V4L2":  # others decode regardless
            return "bgr24"
        code = int(self._capture.get(self._cv2.CAP_PROP_FOURCC)) & 0xFFFFFFFF
        encoding = _PASSED_ON.get(code.to_bytes(4, "little").decode("latin-1"))
        wanted = "mjpeg" if video.capture_format == "auto" else video.capture_format
        if encoding is None or encoding != wanted:
            return "bgr24"
        return encoding if self._capture.set(self._cv2.CAP_PROP_CONVERT_RGB, 0) else "bgr24"

    def _first_picture(self) -> FrameInfo:
        """Read a picture; return the metadata of what the camera really sends."""
        self._wait()
        first = self._retrieve()
        if self._format == "bgr24":
            if first.ndim != 3 or first.shape[2] != 3:
                raise DeviceError(f"{self._name} sends pictures of shape {first.shape}, not BGR")
            height, width = first.shape[:2]
            return FrameInfo(format="bgr24", width=width, height=height, stride=3 * width)
        width, height = (
            int(self._capture.get(prop)) for prop in (self._cv2.CAP_PROP_FRAME_WIDTH, self._cv2.CAP_PROP_FRAME_HEIGHT)
        )
        stride = 2 * width if self._format == "yuyv" else 0  # a JPEG has no rows
        return FrameInfo(format=self._format, width=width, height=height, stride=stride)

    def _wait(self) -> None:
        if not self._capture.grab():
            raise DeviceError(f"{self._name} gives no picture: unplugged, hung, or at its end")

    def _retrieve(self, into: Bytes | None = None) -> NDArray[np.uint8]:
        good, picture = self._capture.retrieve(into)
        if not good or picture is None:
            raise DeviceError(f"{self._name} gave a picture that cannot be read")
        return np.asarray(picture)

    def _draw(self, target: Bytes) -> None:
        wanted = target.reshape(self._info.height, self._info.width, 3)
        picture = self._retrieve(wanted)
        if picture.shape != wanted.shape:
            raise DeviceError(f"{self._name} changed the size of its pictures")
        if not np.shares_memory(picture, wanted):  # not every backend of OpenCV writes into the array given to it
            np.copyto(wanted, picture)


def is_device(name: str) -> bool:
    """True if this names a camera of this machine; other names are files and network streams."""
    return name.isdecimal() or name.startswith("/dev/")


def _without_secrets(device: str) -> str:
    """Return a network camera's URL without its password: the name of a camera is logged and published."""
    scheme, separator, address = device.partition("://")
    if not separator:
        return device
    address = address.partition("?")[0]
    return f"{scheme}://{address.rpartition('@')[2]}"
