"""One frame as a reader gets it."""

from __future__ import annotations

from typing import Any

import numpy as np

from pebble.errors import TransportError
from pebble.transports.frame_info import FrameInfo
from pebble.transports.frame_picture import picture

Bytes = np.ndarray[Any, np.dtype[np.uint8]]


class Frame:
    """Bytes and what is said about them.

    Without views the bytes are the caller's own. With views they are read-only and still the writer's: they must be
    looked at soon, and `valid` asked afterwards. Arrays taken from a frame stay readable whatever happens to it.
    """

    __slots__ = ("_buffer", "_data", "info", "shared")

    def __init__(self, info: FrameInfo, data: Bytes, *, shared: bool, buffer: Any = None) -> None:
        self.info = info
        self.shared = shared  # came through shared memory, whether it was copied then or not
        self._data: Bytes | None = data
        self._buffer = buffer  # the ZShm that ``data`` looks into; None: ``data`` is the caller's

    @property
    def data(self) -> Bytes:
        """One-dimensional. Raises TransportError after `release`."""
        if self._data is None:
            raise TransportError("this frame has been released")
        return self._data

    def picture(self, width: int | None = None) -> Bytes:
        """(height, width, 3), BGR; ``width`` pixels wide if given. Raises PayloadError for what is no picture.

        A `bgr24` frame in its own size is not copied: with views that array is a view.
        """
        return picture(self.data, self.info, width)

    def valid(self) -> bool:
        """False: the memory was given to another frame while we looked. What was read may be wrong: throw it away."""
        if self._data is None:
            return False
        return self._buffer is None or bool(self._buffer.is_valid())

    def release(self) -> None:
        """Give the memory back; it is free when no array of it is left either. Forgetting the frame does the same."""
        self._data = self._buffer = None
