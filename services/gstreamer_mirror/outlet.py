"""One socket: the thread that reads a stream of frames, while programs are connected, and copies them to the socket."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from pathlib import Path

from pebble.contract.payloads import MediaReport
from pebble.errors import DeviceError, PayloadError, PebbleError
from pebble.media.rate_meter import RateMeter
from pebble.services.gstreamer_mirror.forms import Form
from pebble.services.gstreamer_mirror.shm_pipe import Bytes, ShmPipe
from pebble.transports.counters import Counters
from pebble.transports.frames import Frame, FrameReader

log = logging.getLogger(__name__)

_CHECK_S = 1.0  # how soon it is noticed that the socket was removed
_POLL_S = 0.1  # how soon a program that connects or leaves is noticed while no frames come
_RETRY_S = 2.0
_QUIET_S = 2.0  # without a frame before that is reported
_END_S = 2.0


class Outlet:
    """Offers ``form`` at the socket ``path``. ``on_end`` runs on its thread if that ends before :meth:`close`.

    Counters: overwritten (frames that the camera replaced while they were copied), refused (of another form).
    """

    def __init__(
        self, form: Form, path: Path, make_reader: Callable[[], FrameReader], on_end: Callable[[], None]
    ) -> None:
        self.form, self.path = form, path
        self.counters = Counters()
        self._make_reader, self._on_end = make_reader, on_end
        self._pipe = ShmPipe(path, form.slot_bytes, form.slots)
        self._meter = RateMeter()
        self._problem = ""  # why the socket cannot be offered
        self._refusal = ""  # why the last frame was not sent
        self._frame_at = 0.0  # when the last one came, or reading began
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"pebble-{form.stream}", daemon=True)

    def open(self) -> None:
        self._thread.start()

    def close(self) -> None:
        self._stopping.set()
        self._pipe.wake()
        self._thread.join(_END_S)

    @property
    def lost(self) -> dict[str, int]:
        """How many frames did not reach a program, by reason."""
        pipe = self._pipe.counters
        return self.counters.snapshot() | {name: pipe[name] for name in ("behind", "full")}

    def report(self, now: float) -> MediaReport:
        """What it does. Any thread may ask."""
        readers, rate = self._pipe.readers, self._meter.rate(now)
        form = self.form
        return MediaReport(
            running=not self._problem,
            doing=self._doing(readers, rate),
            encoding=form.encoding,
            width=form.width,
            height=form.height,
            rate=round(rate, 1),
            readers=readers,
            dropped=sum(self.lost.values()),
            last_error=self._trouble(readers, now) or None,
        )

    def _doing(self, readers: int, rate: float) -> str:
        if self._problem:
            return f"offers nothing, tries again every {_RETRY_S:g} s"
        if not readers:
            return f"rests: no program reads {self.path}"
        programs = "1 program" if readers == 1 else f"{readers} programs"
        return f"{self.form.description} at {self.path}, {programs}, {rate:.1f}/s"

    def _trouble(self, readers: int, now: float) -> str:
        quiet_s = now - self._frame_at
        if not self._problem and readers and self._frame_at and quiet_s > _QUIET_S:
            return f"no frame from the {self.form.stream} for {quiet_s:.0f} s"
        return self._problem or self._refusal

    # -- its thread

    def _run(self) -> None:
        try:
            while not self._stopping.is_set():
                try:
                    with self._pipe:
                        self._offer()
                except PebbleError as error:
                    self._fail(str(error))
                    self._stopping.wait(_RETRY_S)
        finally:
            if not self._stopping.is_set():
                self._on_end()

    def _fail(self, why: str) -> None:
        if why != self._problem:
            log.warning("%s", why)
        self._problem = why

    def _offer(self) -> None:
        self._problem = ""
        log.info("%s at %s", self.form.description, self.path)
        while not self._stopping.is_set():
            self._pipe.wait(_CHECK_S)
            self._check()
            if self._pipe.readers and not self._stopping.is_set():
                self._feed()

    def _check(self) -> None:
        if not self._pipe.in_place:
            raise DeviceError(f"{self.path} or its shared memory was removed: made again")

    def _feed(self) -> None:
        """Read frames while programs are connected."""
        self._frame_at = checked_at = time.monotonic()
        with self._make_reader() as reader:
            while self._pipe.readers and not self._stopping.is_set():
                frame = reader.read(_POLL_S)
                now = time.monotonic()
                if frame is None:
                    self._pipe.wait()
                else:
                    self._frame_at = now
                    self._send(frame, now)
                if now - checked_at >= _CHECK_S:
                    checked_at = now
                    self._check()
        self._meter.clear()

    def _send(self, frame: Frame, now: float) -> None:
        self._pipe.wait()
        if not self._pipe.wanted:  # nothing need be decoded
            self._pipe.skip()
            frame.release()
            return
        try:
            size, draw = self.form.buffer(frame)
        except PayloadError as error:
            self._refuse(str(error))
        else:
            self._put(frame, size, draw, now)
        finally:
            frame.release()

    def _put(self, frame: Frame, size: int, draw: Callable[[Bytes], None], now: float) -> None:
        def whole(room: Bytes) -> bool:
            draw(room)
            if not frame.valid():
                self.counters.add("overwritten")
                return False
            return True

        if self._pipe.put(size, whole):
            self._refusal = ""
            self._meter.add(now, size)

    def _refuse(self, why: str) -> None:
        self.counters.add("refused")
        if why != self._refusal:
            log.warning("%s", why)
        self._refusal = why
