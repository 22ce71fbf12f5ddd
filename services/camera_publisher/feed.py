"""The camera's frames, read on a thread of its own: only the newest one waits for the service."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

from pebble.errors import PebbleError
from pebble.transports.frame import Frame
from pebble.transports.frames import FrameReader

log = logging.getLogger(__name__)

_LOOK_S = 0.25  # how soon a change of mind is noticed
_LINGER_S = 3.0  # the camera is let go of when nobody wanted its frames for so long
_RETRY_S = 2.0


class Feed:
    """Reads while ``wanted``. ``arrived()`` is called on the feed's thread for every frame and must only hand over.

    ``ended()`` is called there if the thread ends before it was told to.
    """

    def __init__(
        self, make_reader: Callable[[], FrameReader], arrived: Callable[[], None], ended: Callable[[], None]
    ) -> None:
        self.problem = ""  # why there is no reader; empty while there is one
        self._make_reader, self._arrived, self._ended = make_reader, arrived, ended
        self._wanted, self._stopping = threading.Event(), threading.Event()
        self._lock = threading.Lock()
        self._newest: Frame | None = None
        self._thread = threading.Thread(target=self._run, name="pebble-camera", daemon=True)

    @property
    def wanted(self) -> bool:
        return self._wanted.is_set()

    @wanted.setter
    def wanted(self, wanted: bool) -> None:
        if wanted:
            self._wanted.set()
        else:
            self._wanted.clear()
            self._put(None)

    def open(self) -> None:
        self._thread.start()

    def close(self) -> None:
        self._stopping.set()
        self._wanted.set()
        if self._thread.is_alive():
            self._thread.join(2.0)
        self._put(None)

    def take(self) -> Frame | None:
        """The newest frame, once; the caller releases it."""
        with self._lock:
            frame, self._newest = self._newest, None
        return frame

    def _put(self, frame: Frame | None) -> None:
        with self._lock:
            old, self._newest = self._newest, frame
        if old is not None:
            old.release()

    def _run(self) -> None:
        try:
            self._read_while_wanted()
        finally:
            if not self._stopping.is_set():
                self._ended()

    def _read_while_wanted(self) -> None:
        while not self._stopping.is_set():
            if not self._wanted.wait(60.0) or self._stopping.is_set():
                continue
            try:
                with self._make_reader() as reader:
                    self.problem = ""
                    self._read(reader)
            except PebbleError as error:
                if str(error) != self.problem:
                    log.warning("the camera's frames cannot be read: %s", error)
                self.problem = str(error)
                self._stopping.wait(_RETRY_S)

    def _read(self, reader: FrameReader) -> None:
        wanted_at = time.monotonic()
        while not self._stopping.is_set() and time.monotonic() - wanted_at < _LINGER_S:
            frame = reader.read(_LOOK_S)
            if self._wanted.is_set():
                wanted_at = time.monotonic()
            elif frame is not None:
                frame.release()
                frame = None
            if frame is not None:
                self._put(frame)
                self._arrived()
