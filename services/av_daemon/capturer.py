"""The thread of one device: opens it while its stream has readers, writes its frames, and retries after failures."""

import logging
import threading
import time
from collections.abc import Callable
from zlib import crc32

import numpy as np
from msgspec.structs import replace

from pebble.errors import NotRunningError, PayloadError, PebbleError
from pebble.extensions.media.frames import FrameInfo, FrameWriter
from pebble.extensions.media.jpeg import SCAN, jpeg_size
from pebble.services.av_daemon.health import NOTHING, Health
from pebble.services.av_daemon.source import Bytes, Capture, Source

log = logging.getLogger(__name__)

_LOOKED_AT = 1 << 18  # bytes of a frame
_POLL_S = 0.1  # how soon the first reader is noticed


class Capturer:
    """A thread that captures until :meth:`end`, which does not wait, because a device can hang.

    After :meth:`end` it neither writes nor reports, even if its device answers at last. ``wait_s``: before it opens the
    device for the first time, as in place of a thread that hangs; ``rest_s``: without a reader, before it closes the
    device.
    """

    def __init__(
        self,
        name: str,
        writer: FrameWriter,
        open_source: Callable[[], Source],
        health: Health,
        *,
        rest_s: float,
        wait_s: float,
    ) -> None:
        self._name, self._writer, self._open_source, self._health = name, writer, open_source, health
        self._rest_s, self._wait_s = rest_s, wait_s
        self._ended = threading.Event()
        self._source: Source | None = None
        self._scratch: Bytes = np.empty(0, np.uint8)  # frames are drawn here if shared memory has no room
        self._thread = threading.Thread(target=self._run, name=f"pebble-{name}", daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        return self._thread.is_alive()

    def end(self) -> None:
        """End soon. Returns at once, whatever the device does."""
        self._ended.set()
        source = self._source
        if source is not None:
            source.interrupt()

    def join(self, timeout: float) -> bool:
        """Wait for the thread's end; return False if it has not ended, because its device hangs."""
        self._thread.join(timeout)
        return not self._thread.is_alive()

    # -- its thread

    def _run(self) -> None:
        self._ended.wait(self._wait_s)
        while not self._ended.is_set():
            if not self._writer.wanted:
                self._health.idle()
                self._ended.wait(_POLL_S)
                continue
            try:
                self._capture()
            except NotRunningError as error:
                self._failed(str(error), expected=True)
            except PebbleError as error:
                self._failed(str(error))
            except Exception as error:  # of a device's library: this thread must go on
                log.exception("%s failed unexpectedly", self._name)
                self._failed(f"{type(error).__name__}: {error}")

    def _capture(self) -> None:
        self._health.opening(time.monotonic())
        self._source = source = self._open_source()
        try:
            self._pump(source)
        finally:
            self._source = None
            source.close()

    def _pump(self, source: Source) -> None:
        """Deliver the frames of an open device, until :meth:`end`, or until there was no reader for ``rest_s``."""
        had_reader_at = time.monotonic()
        while not self._ended.is_set():
            now = time.monotonic()
            if self._writer.wanted:
                had_reader_at = now
            elif now - had_reader_at >= self._rest_s:
                return
            self._deliver(source.grab())

    def _deliver(self, capture: Capture) -> None:
        info, content = self._write(capture) if self._writer.wanted else (capture.info, None)
        if not self._ended.is_set():
            self._health.frame(info, time.monotonic(), skipped=capture.skipped, content=content)

    def _write(self, capture: Capture) -> tuple[FrameInfo, int | str | None]:
        """Write a frame; return its metadata, and its content for the check of the device's health."""
        # A frame that has still to be drawn is drawn into shared memory, if there is room for it.
        slot = self._writer.slot(capture.size) if capture.draw is not None else None
        pixels = capture.pixels(self._scratch_for(capture) if slot is None else slot.array)
        info, content = _with_real_size(capture.info, pixels), _content(capture.info, pixels)
        if self._ended.is_set():  # the device answered after another thread had taken over
            return info, None
        if slot is None:
            self._writer.write(pixels, _stamped(capture, info))
        else:
            slot.send(_stamped(capture, info))
        return info, content

    def _scratch_for(self, capture: Capture) -> Bytes:
        if capture.draw is not None and len(self._scratch) != capture.size:
            self._scratch = np.empty(capture.size, np.uint8)
        return self._scratch

    def _failed(self, why: str, *, expected: bool = False) -> None:
        if self._ended.is_set():
            return
        delay = self._health.failed(why, expected=expected)
        log.warning("%s: %s; it is opened again in %g s", self._name, why, delay)
        self._ended.wait(delay)


def _with_real_size(info: FrameInfo, data: Bytes) -> FrameInfo:
    """Return ``info`` with the size in the JPEG itself, which may differ from the requested size."""
    if info.format != "mjpeg":
        return info
    try:
        width, height = jpeg_size(data.tobytes())
    except PayloadError:  # its readers refuse it
        return info
    return info if (width, height) == (info.width, info.height) else replace(info, width=width, height=height)


def _content(info: FrameInfo, data: Bytes) -> int | str:
    """Return a checksum of the frame's bytes; NOTHING for sound that is all zeros, as of a muted microphone.

    Of a large frame only some bytes are read, because in a camera's frames all bytes change; of a JPEG those of the
    picture, as its header may hold a time.
    """
    if info.rate and not data.any():
        return NOTHING
    if info.format == "mjpeg":
        data = data[max(0, data.tobytes().find(SCAN)) :]
    return crc32(data[:: data.size // _LOOKED_AT + 1].tobytes())


def _stamped(capture: Capture, info: FrameInfo) -> FrameInfo:
    now_ns = time.monotonic_ns()
    at_ns = capture.at_ns or now_ns
    return replace(info, captured_ns=at_ns, captured_ms=(time.time_ns() - (now_ns - at_ns)) // 1_000_000)
