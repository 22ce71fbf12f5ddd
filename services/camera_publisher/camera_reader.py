"""Reads the camera's frames on a thread, and holds the newest one for the service."""

import logging
import threading
import time
from collections.abc import Callable

from pebble.errors import PebbleError
from pebble.extensions.media.frames import FrameReader
from pebble.extensions.media.frames.frame import Frame

log = logging.getLogger(__name__)

_POLL_S = 0.25  # how soon a change of ``enabled`` takes effect
_LINGER_S = 3.0  # the stream is closed after being disabled for so long
_RETRY_S = 2.0


class CameraReader:
    """A reader that can be ``enabled``. ``on_frame()`` runs on its thread for every frame, and must be quick.

    ``on_end()`` runs there if the thread ends before :meth:`close`.
    """

    def __init__(
        self, make_reader: Callable[[], FrameReader], on_frame: Callable[[], None], on_end: Callable[[], None]
    ) -> None:
        self.problem = ""  # why the stream cannot be read; empty while it can
        self._make_reader, self._on_frame, self._on_end = make_reader, on_frame, on_end
        self._enabled, self._stopping = threading.Event(), threading.Event()
        self._lock = threading.Lock()
        self._newest: Frame | None = None
        self._thread = threading.Thread(target=self._run, name="pebble-camera", daemon=True)

    @property
    def enabled(self) -> bool:
        return self._enabled.is_set()

    @enabled.setter
    def enabled(self, enabled: bool) -> None:
        if enabled:
            self._enabled.set()
        else:
            self._enabled.clear()
            self._put(None)

    def open(self) -> None:
        self._thread.start()

    def close(self) -> None:
        self._stopping.set()
        self._enabled.set()
        if self._thread.is_alive():
            self._thread.join(2.0)
        self._put(None)

    def take(self) -> Frame | None:
        """Return the newest frame, once; None if there is no new one. The caller releases it."""
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
            self._read_while_enabled()
        finally:
            if not self._stopping.is_set():
                self._on_end()

    def _read_while_enabled(self) -> None:
        while not self._stopping.is_set():
            # with a limit: close() sets ``enabled``, but another thread may clear it before this waits
            if not self._enabled.wait(60.0) or self._stopping.is_set():
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
        """Pass on frames while this is enabled. While it is not, drop them; return after ``_LINGER_S`` of that."""
        enabled_at = time.monotonic()
        while not self._stopping.is_set() and time.monotonic() - enabled_at < _LINGER_S:
            frame = reader.read(_POLL_S)
            if self._enabled.is_set():
                enabled_at = time.monotonic()
                if frame is not None:
                    self._put(frame)
                    self._on_frame()
            elif frame is not None:
                frame.release()
