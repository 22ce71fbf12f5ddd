"""The serial line to an MCU: reopens after an unplug, sends without blocking, and sends the stop first and last."""

from __future__ import annotations

import logging
import os
import select
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from enum import Enum

from pebble.errors import DeviceError
from pebble.services.serial_mcu_bridge.line.outbox import Outbox
from pebble.services.serial_mcu_bridge.line.port import Port

log = logging.getLogger(__name__)

_FIRST_RETRY_S, _LAST_RETRY_S = 0.1, 1.0
_RETRY_WRITE_S = 0.002  # while bytes are being sent; a drive line takes 1.4 ms at 115200 baud
_UNREAD_S = 1.0  # without a report, from a board that reports at rest
_STALL_S = 1.0  # a device that accepts nothing for so long is closed and opened again
_DRAIN_S = 0.3  # for the last stop line to be sent
_PATH_CHECK_S = 1.0
_BITS_PER_BYTE = 10  # 8N1


class LineState(Enum):
    CLOSED = "closed"
    ABSENT = "absent"  # no such device, or it has gone; opened again and again until closed
    BOOTING = "booting"  # open, stop line sent; boards that reset on opening have time to boot
    READY = "ready"


class SerialLine:
    """One serial port and its reading thread. Any thread may call any method; only :meth:`close` blocks, up to 0.8 s.

    Every opening sends a line end, because the device may hold half an earlier line, and then the stop as the first
    line. During ``boot_s`` input is discarded; then the stop is sent again, and after it the lines that were added
    since the opening. Only the newest of each kind waits (:class:`Outbox`); described commands use up to 8 kinds
    per interface.

    ``on_bytes(chunk)`` and ``on_state(state, problem)`` run on the reading thread and must return at once.
    ``stop`` is the line that stops the motors, empty where there are none; ``drive_timeout_s`` the age at which a drive
    line expires. ``end`` is what ends a text line, or a frame; empty where nothing is ever sent.
    ``retry_s`` is the longest wait between two attempts to open the device.

    A pseudo-terminal hides how much its reader has left unread. There a device that ``reports_at_rest`` gets a stop
    instead of drive lines once it has been silent for 1 s, and nothing more until it is heard: else it might obey
    commands that are minutes old.
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
        read_timeout_s: float = 0.1,
        retry_s: float = _LAST_RETRY_S,
        end: bytes = b"\n",
    ) -> None:
        self.path, self.baud = path, baud
        self.opened = 0  # how often the device was opened
        self.refused = 0  # lines refused because there was no device
        self.unread = 0  # drive lines that were not sent, because earlier ones were probably not read
        self.reports_at_rest = False  # set by the owner, who knows the protocol
        self.received = 0  # chunks of bytes from the device since it was opened and has booted
        self.outbox = Outbox(stop, drive_timeout_s)
        self._stop, self._boot_s, self._read_timeout = stop, boot_s, read_timeout_s
        self._retry, self._end = retry_s, end
        self._on_bytes, self._on_state = on_bytes, on_state
        self._byte_s = _BITS_PER_BYTE / baud
        self._thread = threading.Thread(target=self._run, name=f"pebble-serial {path}", daemon=True)
        self._lock = threading.Lock()  # guards everything below
        self._state = LineState.CLOSED
        self._problem = ""
        self._closing = False
        self._port: Port | None = None
        self._failure: DeviceError | None = None  # raised while writing on a caller's thread
        self._received_at = 0.0
        self._stopped_unread = False
        self._sending = b""  # lines, or the rest of one, not yet written to the kernel
        self._busy_until = 0.0  # when all written bytes have had time to be sent
        self._blocked_since: float | None = None
        self._wakeup_read, self._wakeup_write = os.pipe()
        os.set_blocking(self._wakeup_read, False)
        os.set_blocking(self._wakeup_write, False)

    @property
    def state(self) -> LineState:
        return self._state

    @property
    def problem(self) -> str:
        """The reason why there is no device; empty while there is one."""
        return self._problem

    @property
    def sent_until(self) -> float:
        """When all that was written to the device has had time to be sent, in monotonic seconds."""
        return self._busy_until

    def open(self) -> None:
        """Start the thread that opens the device. Returns at once."""
        self._thread.start()

    def drive(self, line: bytes, valid_s: float = float("inf")) -> bool:
        """Send a drive line now, or once earlier bytes are sent unless a newer one replaces it. False: no device.

        One that could not be sent for ``valid_s``, or for ``drive_timeout_s``, becomes a stop.
        """
        if self._may_be_unread():
            self.unread += 1
            return self._stop_unread()
        return self._hand_over(lambda now: self.outbox.drive(line, now, valid_s), line if valid_s > 0 else b"")

    def halt(self) -> bool:
        """Send the stop in place of any waiting drive line. False: no device; opening it begins with the stop."""
        return self._hand_over(lambda _now: self.outbox.halt(), self._stop)

    def send(self, kind: str, line: bytes) -> bool:
        """Send a line that drives nothing; a waiting one of the same ``kind`` is replaced. False: no device."""
        return self._hand_over(lambda _now: self.outbox.put(kind, line), line)

    def close(self, timeout: float = 0.8) -> None:
        """Send the stop as the last line, wait up to 0.3 s until it is sent, and close the device permanently."""
        with self._lock:
            if self._closing:
                return
            self._closing = True
            self.outbox.clear()
            self._sending += self._stop if self._port is not None else b""
            with suppress(DeviceError):  # the reading thread will meet it, too
                self._pump(time.monotonic())
            self._wake()
        if self._thread.ident is not None:
            self._thread.join(timeout)
        if self._thread.is_alive():
            log.warning("%s does not close in time; it closes when the process ends", self.path)
            return
        os.close(self._wakeup_read)
        os.close(self._wakeup_write)

    # -- any thread

    def _may_be_unread(self) -> bool:
        port = self._port
        hidden = port is not None and port.hides_queue and self.reports_at_rest and self._state is LineState.READY
        return hidden and time.monotonic() - self._received_at > _UNREAD_S

    def _stop_unread(self) -> bool:
        """Send one stop in place of all drive lines until the device is heard again."""
        if self._stopped_unread:
            return True
        self._stopped_unread = True
        log.warning("%s: silent for %g s, and perhaps not read: stopped until it reports again", self.path, _UNREAD_S)
        return self.halt()

    def _hand_over(self, place: Callable[[float], None], line: bytes) -> bool:
        """Write ``line`` at once, on the caller's thread, or ``place`` it in the outbox if it has to wait."""
        now = time.monotonic()
        with self._lock:
            if self._port is None or self._closing:
                self.refused += 1
                return False
            was_idle = not self._sending and not self.outbox.waiting
            try:
                if was_idle and line and self._is_free(self._port, now):
                    self._sending = line
                else:
                    place(now)
                self._pump(now)
            except DeviceError as error:
                self._failure = error
                self._wake()
            if was_idle and (self._sending or self.outbox.waiting):
                self._wake()  # so that the reading thread sends the rest
            return True

    def _pump(self, now: float) -> None:
        """Write lines until the kernel accepts no more. Lock held."""
        while self._port is not None and (self._sending or (self.outbox.waiting and self._next_line(self._port, now))):
            sent = self._port.write(self._sending)
            if not sent:
                return
            self._sending = self._sending[sent:]
            self._busy_until = max(now, self._busy_until) + sent * self._byte_s
            self._blocked_since = None

    def _next_line(self, port: Port, now: float) -> bool:
        """Take a line from the outbox if it can be sent at once: a line in the kernel cannot be replaced."""
        if not self._is_free(port, now):
            return False
        self._sending = self.outbox.take(now) or b""
        return bool(self._sending)

    def _is_free(self, port: Port, now: float) -> bool:
        """Whether the device has sent all that was written to it. Lock held."""
        return self._state is LineState.READY and now >= self._busy_until and not port.queued()

    def _wake(self) -> None:
        with suppress(BlockingIOError):  # full: it wakes up anyway
            os.write(self._wakeup_write, b"!")

    # -- the reading thread

    def _run(self) -> None:
        try:
            retry_s = _FIRST_RETRY_S
            while not self._closing:
                try:
                    self._serve_opening(Port(self.path, self.baud))
                except DeviceError as error:
                    if self._state is LineState.READY:
                        retry_s = _FIRST_RETRY_S
                    self._set_state(LineState.ABSENT, str(error))
                    self._pause(retry_s)
                    retry_s = min(2 * retry_s, self._retry)
        finally:
            self._set_state(LineState.CLOSED)

    def _serve_opening(self, port: Port) -> None:
        """Serve the device from opening to closing. Raises DeviceError when it has gone."""
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
            port.discard_output()  # an earlier process may have left old commands in the kernel
            self._port, self._failure, self._blocked_since = port, None, None
            self.outbox.clear()
            self._sending = self._end + self._stop
            self._pump(time.monotonic())
        self._set_state(LineState.BOOTING)

    def _serve(self, port: Port) -> None:
        poller = select.poll()
        poller.register(port, select.POLLIN)
        poller.register(self._wakeup_read, select.POLLIN)
        now = time.monotonic()
        ready_at, path_check_at = now + self._boot_s, now + _PATH_CHECK_S
        if self._boot_s <= 0:
            self._become_ready()  # before the first byte is read: it must not be discarded
        while not self._closing:
            ready = {fd for fd, _ in poller.poll(1000 * self._poll_timeout(ready_at - now))}
            if self._wakeup_read in ready:
                self._clear_wakeups()
            if port.fileno() in ready:
                self._receive(port.read())
            now = time.monotonic()
            if self._state is LineState.BOOTING and now >= ready_at:
                self._become_ready()
            with self._lock:
                self._write_waiting(now)
            if now >= path_check_at:
                path_check_at = now + _PATH_CHECK_S
                if port.is_replaced():
                    raise DeviceError(f"{self.path} is another device now")

    def _poll_timeout(self, until_ready: float) -> float:
        """Return how long to wait for input before writing again, in seconds."""
        if self._state is LineState.BOOTING:
            return max(_RETRY_WRITE_S, min(self._read_timeout, until_ready))
        return _RETRY_WRITE_S if self._sending or self.outbox.waiting else self._read_timeout

    def _receive(self, chunk: bytes) -> None:
        if chunk and self._state is LineState.READY:
            self.received += 1
            self._received_at, self._stopped_unread = time.monotonic(), False
            self._on_bytes(chunk)

    def _become_ready(self) -> None:
        with self._lock:
            self._sending += self._stop
            self._received_at, self._stopped_unread = time.monotonic(), False
            hidden = self._port is not None and self._port.hides_queue
        self._set_state(LineState.READY)
        if hidden and self._stop:
            log.info("%s is a pseudo-terminal: a reader that stands still may obey drive lines late", self.path)

    def _write_waiting(self, now: float) -> None:
        """Write what waits; raise DeviceError for a device that accepts nothing. Lock held."""
        if self._failure is not None:
            raise self._failure
        self._pump(now)
        if not self._sending and not self.outbox.waiting:
            self._blocked_since = None
        elif self._state is LineState.READY:
            if self._blocked_since is None:
                self._blocked_since = now
            elif now - self._blocked_since > _STALL_S:
                self._discard_output()
                raise DeviceError(f"{self.path} has accepted nothing for {_STALL_S} s")

    def _discard_output(self) -> None:
        """Discard the old commands that a stuck device would execute later. Lock held."""
        if self._port is not None:
            self._port.discard_output()

    def _finish(self, port: Port) -> None:
        """Wait up to 0.3 s until the last stop is sent; for a stuck device it replaces all earlier output."""
        end = time.monotonic() + _DRAIN_S
        while time.monotonic() < end:
            with self._lock:
                self._pump(time.monotonic())
                if not self._sending and not port.queued():
                    return
            time.sleep(_RETRY_WRITE_S)
        port.discard_output()
        port.write(self._end + self._stop)

    def _set_state(self, state: LineState, problem: str = "") -> None:
        with self._lock:
            if (state, problem) == (self._state, self._problem):
                return
            self._state, self._problem = state, problem
        if problem:
            log.warning("%s", problem)
        else:
            log.info("%s: %s", self.path, state.value)
        self._on_state(state, problem)

    def _pause(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        poller = select.poll()
        poller.register(self._wakeup_read, select.POLLIN)
        while not self._closing and (left := end - time.monotonic()) > 0:
            if poller.poll(1000 * left):
                self._clear_wakeups()

    def _clear_wakeups(self) -> None:
        with suppress(BlockingIOError):
            os.read(self._wakeup_read, 4096)
