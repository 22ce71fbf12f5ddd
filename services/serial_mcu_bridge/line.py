"""The serial line to an MCU: found again after an unplug, never blocking its user, motors stopped first and last."""

from __future__ import annotations

import logging
import os
import select
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from enum import Enum

from pebble.errors import LinkError
from pebble.services.serial_mcu_bridge.outbox import Outbox
from pebble.services.serial_mcu_bridge.port import Port

log = logging.getLogger(__name__)

_FIRST_RETRY_S, _LAST_RETRY_S = 0.1, 1.0
_RETRY_WRITE_S = 0.002  # while the wire is busy; a drive line takes 1.4 ms at 115200 baud
_STALL_S = 1.0  # a device that takes nothing for so long is closed and opened again
_DRAIN_S = 0.3  # for the last stop to leave
_PATH_CHECK_S = 1.0
_BITS_PER_BYTE = 10  # 8N1


class LineState(Enum):
    CLOSED = "closed"
    ABSENT = "absent"  # no such device, or it went away; looked for again until closed
    SETTLING = "settling"  # open and stopped; boards that reset on opening get time to boot
    READY = "ready"


class SerialLine:
    """One serial port and the thread that reads it. All methods may be called from any thread and never block.

    At every opening the stop is the first line sent; after ``settle_s`` input is thrown away, the stop is sent again,
    and only then what was handed over since the opening. Lines do not queue: see :class:`Outbox`.

    ``on_bytes(chunk)`` and ``on_state(state, problem)`` run on the line's thread and must only hand over.
    ``stop`` is the line that halts the motors, empty where there are none; ``drive_timeout_s`` the age at which a drive
    line is worth nothing. ``end`` is what ends a line, or a frame. ``retry_s`` is the longest wait between two looks
    for a device that is not there.
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
        settle_s: float = 0.5,
        read_timeout_s: float = 0.1,
        retry_s: float = _LAST_RETRY_S,
        end: bytes = b"\n",
    ) -> None:
        self.path, self.baud = path, baud
        self.opened = 0  # how often the device was opened
        self.refused = 0  # lines handed over while there was no device
        self.outbox = Outbox(stop, drive_timeout_s)
        self._stop, self._settle, self._read_timeout = stop, settle_s, read_timeout_s
        self._retry, self._end = retry_s, end
        self._on_bytes, self._on_state = on_bytes, on_state
        self._byte_s = _BITS_PER_BYTE / baud
        self._thread = threading.Thread(target=self._run, name=f"pebble-serial {path}", daemon=True)
        self._lock = threading.Lock()  # guards everything below
        self._state = LineState.CLOSED
        self._problem = ""
        self._closing = False
        self._port: Port | None = None
        self._failure: LinkError | None = None  # met while writing on somebody else's thread
        self._sending = b""  # lines, or the rest of one, that the kernel has not taken yet
        self._torn = False  # the device may hold half a line of ours
        self._busy_until = 0.0  # when the wire has had time for all that was written
        self._blocked_since: float | None = None
        self._awake, self._waker = os.pipe()
        os.set_blocking(self._awake, False)
        os.set_blocking(self._waker, False)

    @property
    def state(self) -> LineState:
        return self._state

    @property
    def problem(self) -> str:
        """Why there is no device; empty while there is one."""
        return self._problem

    def open(self) -> None:
        """Start looking for the device. Returns at once."""
        self._thread.start()

    def drive(self, line: bytes) -> bool:
        """Send a drive line now, or as soon as the wire is free unless a newer one comes first. False: no device."""
        return self._hand_over(lambda now: self.outbox.drive(line, now))

    def halt(self) -> bool:
        """Send the stop in place of any waiting drive line. False: no device; its opening will begin with the stop."""
        return self._hand_over(lambda _now: self.outbox.halt())

    def send(self, kind: str, line: bytes) -> bool:
        """Send a line that drives nothing; a waiting one of the same ``kind`` is replaced. False: no device."""
        return self._hand_over(lambda _now: self.outbox.put(kind, line))

    def close(self, timeout: float = 0.8) -> None:
        """Send the stop as the last line, give it up to 0.3 s to leave, and release the device. For good."""
        with self._lock:
            if self._closing:
                return
            self._closing = True
            self.outbox.clear()
            self._sending += self._stop if self._port is not None else b""
            self._try_pump(time.monotonic())
            self._wake()
        if self._thread.ident is not None:
            self._thread.join(timeout)
        if self._thread.is_alive():
            log.warning("%s does not let go; left to the end of the process", self.path)
            return
        os.close(self._awake)
        os.close(self._waker)

    # -- any thread

    def _hand_over(self, place: Callable[[float], None]) -> bool:
        now = time.monotonic()
        with self._lock:
            if self._port is None or self._closing:
                self.refused += 1
                return False
            was_idle = not self._sending and not self.outbox
            place(now)
            self._try_pump(now)
            if was_idle and (self._sending or self.outbox):
                self._wake()  # to look after the output until it has left
            return True

    def _try_pump(self, now: float) -> None:
        """Write from here what can be written: no thread switch between a command and the wire. Lock held."""
        try:
            self._pump(now)
        except LinkError as error:
            self._failure = error
            self._wake()

    def _pump(self, now: float) -> None:
        """Move lines to the wire until it is busy. Lock held."""
        while self._port is not None and (self._sending or self._next_line(self._port, now)):
            sent = self._port.write(self._sending)
            if not sent:
                return
            self._torn = not self._sending[:sent].endswith(self._end)
            self._sending = self._sending[sent:]
            self._busy_until = max(now, self._busy_until) + sent * self._byte_s
            self._blocked_since = None

    def _next_line(self, port: Port, now: float) -> bool:
        """Take a line from the outbox if it would leave at once: what is in the kernel cannot be replaced any more."""
        if self._state is not LineState.READY or not self.outbox or now < self._busy_until or port.queued():
            return False
        self._sending = self.outbox.take(now) or b""
        return bool(self._sending)

    def _wake(self) -> None:
        with suppress(BlockingIOError):  # full: it is awake
            os.write(self._waker, b"!")

    # -- the line's thread

    def _run(self) -> None:
        try:
            retry_s = _FIRST_RETRY_S
            while not self._closing:
                try:
                    self._live(Port(self.path, self.baud))
                except LinkError as error:
                    if self._state is LineState.READY:
                        retry_s = _FIRST_RETRY_S
                    self._say(LineState.ABSENT, str(error))
                    self._pause(retry_s)
                    retry_s = min(2 * retry_s, self._retry)
        finally:
            self._say(LineState.CLOSED)

    def _live(self, port: Port) -> None:
        """Serve one opening of the device. Raises LinkError when it has gone."""
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
            port.forget_output()  # what a killed predecessor left in the kernel is old by now
            self._port, self._failure, self._blocked_since = port, None, None
            self.outbox.clear()
            self._sending = (self._end if self._torn else b"") + self._stop
            self._pump(time.monotonic())
        self._say(LineState.SETTLING)

    def _serve(self, port: Port) -> None:
        poller = select.poll()
        poller.register(port, select.POLLIN)
        poller.register(self._awake, select.POLLIN)
        now = time.monotonic()
        settled_at, look_at = now + self._settle, now + _PATH_CHECK_S
        if self._settle <= 0:
            self._settled()  # before the first byte is read: it counts
        while not self._closing:
            ready = {fd for fd, _ in poller.poll(1000 * self._patience(settled_at - now))}
            if self._awake in ready:
                self._doze()
            if port.fileno() in ready:
                self._receive(port.read())
            now = time.monotonic()
            if self._state is LineState.SETTLING and now >= settled_at:
                self._settled()
            with self._lock:
                self._push(now)
            if now >= look_at:
                look_at = now + _PATH_CHECK_S
                if port.is_replaced():
                    raise LinkError(f"{self.path} is another device now")

    def _patience(self, until_settled: float) -> float:
        """How long to wait for input before looking after the output again, seconds."""
        if self._state is LineState.SETTLING:
            return max(_RETRY_WRITE_S, min(self._read_timeout, until_settled))
        return _RETRY_WRITE_S if self._sending or self.outbox else self._read_timeout

    def _receive(self, chunk: bytes) -> None:
        if chunk and self._state is LineState.READY:
            self._on_bytes(chunk)

    def _settled(self) -> None:
        with self._lock:
            self._sending += self._stop
        self._say(LineState.READY)

    def _push(self, now: float) -> None:
        """Write what waits; raise LinkError for a device that takes nothing. Lock held."""
        if self._failure is not None:
            raise self._failure
        self._pump(now)
        if not self._sending and not self.outbox:
            self._blocked_since = None
        elif self._state is LineState.READY:
            if self._blocked_since is None:
                self._blocked_since = now
            elif now - self._blocked_since > _STALL_S:
                self._unclog()
                raise LinkError(f"{self.path} has taken nothing for {_STALL_S} s")

    def _unclog(self) -> None:
        """Throw away the old commands that a stuck device would find when it wakes up. Lock held."""
        if self._port is not None:
            self._port.forget_output()
            self._torn = True

    def _finish(self, port: Port) -> None:
        """Wait, bounded, until the last stop has left; a stuck device gets it in place of everything before."""
        end = time.monotonic() + _DRAIN_S
        while time.monotonic() < end:
            with self._lock:
                self._pump(time.monotonic())
                if not self._sending and not port.queued():
                    return
            time.sleep(_RETRY_WRITE_S)
        port.forget_output()
        port.write(self._end + self._stop)

    def _say(self, state: LineState, problem: str = "") -> None:
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
        poller.register(self._awake, select.POLLIN)
        while not self._closing and (left := end - time.monotonic()) > 0:
            if poller.poll(1000 * left):
                self._doze()

    def _doze(self) -> None:
        with suppress(BlockingIOError):
            os.read(self._awake, 4096)
