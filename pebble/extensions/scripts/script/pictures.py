"""The pictures of a robot's camera, one at a time or in a loop."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any
from weakref import WeakSet

if TYPE_CHECKING:
    from pebble.extensions.media.cameras import Camera, Picture


class Pictures:
    """The robot's camera. It is opened, and its modules are imported, at first use. One thread reads; any may close."""

    def __init__(self, run_dir: Path) -> None:
        self._run_dir = run_dir
        self._changing = threading.Lock()
        self._cameras: WeakSet[Camera] = WeakSet()
        self._polled: Camera | None = None  # the camera of :meth:`newest`
        self._last: Picture | None = None  # its newest picture, unless that is too old
        self._closed = False

    def every(self, **options: Any) -> Iterator[Picture]:
        """Yield pictures from now on, always the newest; see `pebble.camera`."""
        with self._open(**options) as view:
            yield from view

    def newest(self, max_age: float) -> Picture | None:
        """Return the newest picture, if it was captured within the last ``max_age`` seconds. Does not wait."""
        if self._polled is None:
            self._polled = self._open()
        picture = self._polled.newest()
        if picture is not None:
            self._last = picture
        frame = self._polled.frame
        if frame is None or time.monotonic_ns() - frame.info.captured_ns > max_age * 1e9:
            self._last = None
        return self._last

    def close(self) -> None:
        """End all loops over pictures."""
        with self._changing:
            self._closed = True
            cameras = list(self._cameras)
        for view in cameras:
            view.close()

    def _open(self, **options: Any) -> Camera:
        from pebble.extensions.media.cameras import camera

        view = camera(self._run_dir, **options)
        with self._changing:
            self._cameras.add(view)
            closed = self._closed
        if closed:
            view.close()
        return view
