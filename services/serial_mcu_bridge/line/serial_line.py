"""The serial line to an MCU: reopens after an unplug, sends without blocking, and sends the stop first and last."""

import logging
import select
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from enum import Enum
from typing import NamedTuple

from pebble.errors import DeviceError
from pebble.services.serial_mcu_bridge.line.outbox import Outbox
from pebble.services.serial_mcu_bridge.line.output import Output
from pebble.services.serial_mcu_bridge.line.port import Port
from pebble.transports.wakeup import WakeupPipe

log = logging.getLogger(__name__)

_FIRST_RETRY_S, _LAST_RETRY_S = 0.1, 1.0
_RETRY_WRITE_S = 0.002  # while bytes are being sent; a drive line takes 1.4 ms at 115200 baud
_DRAIN_S = 0.3  # for the last stop line to be sent
_PATH_CHECK_S = 1.0
_READ_S = 0.1  # longest wait for bytes of the device


class LineState(Enum):
    CLOSED = "closed"
    ABSENT = "absent"  # no such device, or it has gone; opened again and again until closed
    BOOTING = "booting"  # open, stop line sent; boards that reset on opening have time to boot
    READY = "ready"


class _Opening(NamedTuple):
    """A device with the parameters for opening it."""

    path: str
    baud: int
    boot_s: float
    retry_s: float


class SerialLine:
    """A serial port and its reading thread. Any thread may call any method; only :meth:`close` blocks, up to 0.8 s.

    Every opening sends a line end, because the device may hold half an earlier line, and then the stop as the first
    line. During ``boot_s`` input is discarded; then the stop is sent again, followed by the lines that were added since
    the opening. Only the newest of each kind waits (:class:`Outbox`); commands to a self-describing MCU use up to
    8 kinds per interface, and 8 for groups of commands.

    ``on_bytes(chunk)`` and ``on_state(state, problem)`` run on the reading thread and must return at once. ``stop`` is
    the line that stops the motors, empty if there are none; ``drive_timeout_s`` the age at which a drive line expires.
    ``end`` ends a text line, or a frame; empty if nothing is ever sent. ``retry_s`` is the longest wait between two
    attempts to open the device.
    """

    def __init__(
        self,
        path: str,
        baud: int,
        *,
        stop: bytes,
        on_bytes: Callable[[bytes], None],
        on_state: Callable[[LineState, str], None] = lambda _state, _problem: None,
        drive_timeout_s: float = 0.75,
        boot_s: float = 0.5,
        retry_s: float = _LAST_RETRY_S,
        end: bytes = b"\n",
    ) -> None:
        self.opened = 0  # how often the device was opened
        self.received = 0  # chunks of bytes from the device since it was opened and has booted
        self._opening = _Opening(path, baud, boot_s, retry_s)
        self._on_bytes, self._on_state = on_bytes, on_state
        self._thread = threading.Thread(target=self._run, name=f"pebble-serial {path}", daemon=True)
        self._wakeup = WakeupPipe()
        self._lock = threading.Lock()  # guards everything below
        self.output = Output(Outbox(stop, drive_timeout_s), stop, end, baud)
        self._state = LineState.CLOSED
        self._problem = ""
        self._closing = False
        self._port: Port | None = None
        self._failure: DeviceError | None = None  # raised while writing on a caller's thread

    @property
    def state(self) -> LineState:
        return self._state

    @property
    def problem(self) -> str:
        """Reason why there is no device; empty while there is one."""
        return self._problem

    def open(self) -> None:
        """Start the thread that opens the device, without waiting for it."""
        self._thread.start()

    def drive(self, line: bytes, valid_s: float = float("inf"), *, replaces: str = "") -> bool:
        """Send a drive line now, or after earlier bytes unless a newer one replaces it; False if there is no device.

        If it could not be sent for ``valid_s``, or for ``drive_timeout_s``, a stop is sent instead. ``replaces``: the
        kind of a second line, such as one for lights, that ``line`` also holds; a waiting line of that kind is dropped.
        """
        outbox = self.output.outbox
        at_once = line if valid_s > 0 else b""  # b"": it may have expired, as the outbox judges
        return self._hand_over(lambda now: outbox.drive(line, now, valid_s, replaces), at_once)

    def halt(self) -> bool:
        """Send the stop in place of a waiting drive line. False without a device: its opening begins with the stop."""
        return self._hand_over(lambda _now: self.output.outbox.halt(), self.output.stop)

    def send(self, kind: str, line: bytes) -> bool:
        """Send a line that does not drive, in place of a waiting line of its ``kind``; False if there is no device."""
        return self._hand_over(lambda _now: self.output.outbox.put(kind, line), line)

    def close(self, timeout: float = 0.8) -> None:
        """Send the stop as the last line, wait up to 0.3 s until it is sent, and close the device permanently."""
        with self._lock:
            if self._closing:
                return
            self._closing = True
            output = self.output
            output.outbox.clear()
            if self._port is not None:
                output.sending += output.stop
                with suppress(DeviceError):  # the reading thread will meet it, too
                    output.write(self._port, time.monotonic(), ready=self._state is LineState.READY)
            self._wakeup.set()
        if self._thread.ident is not None:
            self._thread.join(timeout)
        if self._thread.is_alive():
            log.warning("%s does not close in time; it closes when the process ends", self._opening.path)
            return
        self._wakeup.close()

    # -- any thread

    def _hand_over(self, place: Callable[[float], None], line: bytes) -> bool:
        """Write ``line`` at once; if it is b"" or has to wait, ``place`` fills the outbox. False: not open."""
        now = time.monotonic()
        with self._lock:
            port, output = self._port, self.output
            if port is None or self._closing:
                return False
            was_idle = not output.sending and not output.outbox.waiting
            ready = self._state is LineState.READY
            try:
                if was_idle and line and ready and output.is_free(port, now):
                    output.sending = line
                else:
                    place(now)
                output.write(port, now, ready=ready)
            except DeviceError as error:
                self._failure = error
                self._wakeup.set()
            if was_idle and (output.sending or output.outbox.waiting):
                self._wakeup.set()  # so that the reading thread sends the rest
            return True

    # -- the reading thread

    def _run(self) -> None:
        try:
            retry_s = _FIRST_RETRY_S
            while not self._closing:
                try:
                    self._serve_opening(Port(self._opening.path, self._opening.baud))
                except DeviceError as error:
                    if self._state is LineState.READY:  # it was there, and may be back at once
                        retry_s = _FIRST_RETRY_S
                    self._set_state(LineState.ABSENT, str(error))
                    self._pause(retry_s)
                    retry_s = min(2 * retry_s, self._opening.retry_s)
        finally:
            self._set_state(LineState.CLOSED)

    def _serve_opening(self, port: Port) -> None:
        """Serve the device until it is closed. Raises DeviceError when it is gone."""
        try:
            self._attach(port)
            self._serve(port)
            self._finish(port)
        finally:
            with self._lock:
                self._port = None
            port.close()

    def _attach(self, port: Port) -> None:
        with self._lock:
            self.opened += 1
            self.received = 0
            self._port, self._failure = port, None
            self.output.begin(port)
            self.output.write(port, time.monotonic(), ready=False)
        self._set_state(LineState.BOOTING)

    def _serve(self, port: Port) -> None:
        poller, device, wakeup = select.poll(), port.fileno(), self._wakeup.fileno()
        poller.register(device, select.POLLIN)
        poller.register(wakeup, select.POLLIN)
        now, boot_s = time.monotonic(), self._opening.boot_s
        ready_at, path_check_at = now + boot_s, now + _PATH_CHECK_S
        if boot_s <= 0:
            self._become_ready()  # before the first byte is read: it must not be discarded
        while not self._closing:
            ready = {fd for fd, _ in poller.poll(1000 * self._poll_timeout(ready_at - now))}
            if wakeup in ready:
                self._wakeup.clear()
            if device in ready:
                self._receive(port.read())
            now = time.monotonic()
            if self._state is LineState.BOOTING and now >= ready_at:
                self._become_ready()
            self._write_waiting(port, now)
            if now >= path_check_at:
                path_check_at = now + _PATH_CHECK_S
                if port.is_replaced():
                    raise DeviceError(f"{port.path} is another device now")

    def _poll_timeout(self, until_ready: float) -> float:
        """Return the seconds to wait for input before writing again."""
        if self._state is LineState.BOOTING:
            return max(_RETRY_WRITE_S, min(_READ_S, until_ready))
        return _RETRY_WRITE_S if self.output.sending or self.output.outbox.waiting else _READ_S

    def _receive(self, chunk: bytes) -> None:
        if chunk and self._state is LineState.READY:
            self.received += 1
            self._on_bytes(chunk)

    def _become_ready(self) -> None:
        with self._lock:
            self.output.sending += self.output.stop
        self._set_state(LineState.READY)

    def _write_waiting(self, port: Port, now: float) -> None:
        """Write waiting bytes. Raises DeviceError if the device is gone, or accepts nothing."""
        with self._lock:
            if self._failure is not None:
                raise self._failure
            ready = self._state is LineState.READY
            self.output.write(port, now, ready=ready)
            if ready and (self.output.sending or self.output.outbox.waiting):
                self.output.check_stall(port, now)

    def _finish(self, port: Port) -> None:
        """Wait up to 0.3 s until the last stop is sent; if the device is stuck, replace what is unsent by the stop."""
        end = time.monotonic() + _DRAIN_S
        while time.monotonic() < end:
            with self._lock:
                self.output.write(port, time.monotonic(), ready=self._state is LineState.READY)
                if not self.output.sending and not port.queued():
                    return
            time.sleep(_RETRY_WRITE_S)
        self.output.replace_by_stop(port)

    def _set_state(self, state: LineState, problem: str = "") -> None:
        with self._lock:
            if (state, problem) == (self._state, self._problem):
                return
            self._state, self._problem = state, problem
        if problem:
            log.warning("%s", problem)
        else:
            log.info("%s: %s", self._opening.path, state.value)
        self._on_state(state, problem)

    def _pause(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        poller = select.poll()
        poller.register(self._wakeup, select.POLLIN)
        while not self._closing and (remaining_s := end - time.monotonic()) > 0:
            if poller.poll(1000 * remaining_s):
                self._wakeup.clear()
