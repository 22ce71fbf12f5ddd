"""OpenCV, brought in only where a camera needs it: it is 16 MB that a robot without one does not pay."""

from __future__ import annotations

from typing import Any


def opencv() -> Any:
    """The module, on one thread: a picture is too small a job for several."""
    import cv2

    cv2.setNumThreads(1)
    return cv2
