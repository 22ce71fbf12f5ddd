"""The interface of an open camera or microphone, and the frames it returns."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pebble.extensions.media.frames import FrameInfo

Bytes: TypeAlias = NDArray[np.uint8]  # of any shape


@dataclass(frozen=True, slots=True)
class Capture:
    """A frame from a device: its ``data``, or a function to ``draw`` its ``size`` bytes into an array.

    ``at_ns`` is the time when it was complete (monotonic); 0: when it is drawn. ``skipped``: how many frames before it
    were dropped, because this program was too slow or they were broken.
    """

    info: FrameInfo
    size: int
    data: bytes | bytearray | memoryview | NDArray[Any] | None = None
    draw: Callable[[Bytes], None] | None = None
    at_ns: int = 0
    skipped: int = 0

    def pixels(self, scratch: Bytes) -> Bytes:
        """Return the frame as a one-dimensional array of bytes.

        If it has no data, it is drawn into ``scratch``, of ``size`` bytes.
        """
        if self.draw is not None:
            self.draw(scratch)
            return scratch
        data = self.data
        if isinstance(data, np.ndarray):
            return data.reshape(-1).view(np.uint8)
        return np.frombuffer(data or b"", np.uint8)


class Source(Protocol):
    """An open device. One thread uses it, except for ``interrupt``."""

    def grab(self) -> Capture:
        """Wait for the next frame, which is valid until the next call. Raises DeviceError if the device fails."""

    def close(self) -> None:
        """Release the device."""

    def interrupt(self) -> None:
        """Make a waiting ``grab`` fail soon, if that is possible. Any thread."""


def opencv() -> Any:
    """Return OpenCV, set to use one thread: a picture is too small a job for several.

    It is imported only for a camera that needs it, because it takes 16 MB.
    """
    import cv2

    cv2.setNumThreads(1)
    return cv2
