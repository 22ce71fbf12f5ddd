"""What all services at a serial line share: the line, and the way of its bytes to the service's thread."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from typing import ClassVar

from pebble.config import SerialBridge
from pebble.errors import ConfigError, LinkError
from pebble.rate_limit import RateLimitedLog
from pebble.service import Service
from pebble.services.serial_mcu_bridge.line import LineState, SerialLine

_INPUT_LIMIT = 65_536  # bytes waiting for the service's thread; 1.4 s of a full 460,800 baud line


class SerialService(Service, ABC):
    """A subclass opens the line in ``start`` and understands what comes up it. Without a ``stop`` nothing moves."""

    name = "serial_mcu_bridge"
    end: ClassVar[bytes] = b"\n"  # of a line, or a frame

    def open_line(self, *, stop: bytes = b"", settle_s: float = 0.5, retry_s: float = 1.0) -> None:
        options = self.options
        if options.serial.port is None:
            raise ConfigError("services.serial_mcu_bridge.serial.port: required, for example /dev/ttyACM0")
        self.chatter_log = RateLimitedLog(self.log, burst=20)
        self._input = bytearray()
        self._input_lock = threading.Lock()
        self.line = SerialLine(
            options.serial.port,
            options.serial.baud,
            stop=stop,
            on_bytes=self._take_in,
            on_state=lambda state, _problem: self.post(lambda: self._line_is(state)),
            drive_timeout_s=options.safety.drive_timeout_seconds,
            settle_s=settle_s,
            read_timeout_s=options.serial.timeout_seconds,
            retry_s=retry_s,
            end=self.end,
        )
        self.line.open()

    def stop(self) -> None:
        if hasattr(self, "line"):
            self.line.close()
            chatter, dropped = self.chatter_log.totals(), self.counters["input_dropped"]
            if chatter or dropped:
                self.log.info("lines of the MCU that were no report: %s; bytes dropped unread: %d", chatter, dropped)

    @property
    def options(self) -> SerialBridge:
        """Our section of the config; an instance's own where we are one."""
        return self.config.services.serial_mcu_bridge

    @property
    def republish_interval_s(self) -> float:
        return self.options.retained_publish_interval_seconds

    def exit_if_asked(self) -> None:
        """The device has gone. It is looked for again, unless the config would rather have the process start anew."""
        if self.options.health.exit_on_serial_error and self.line.opened:
            raise LinkError(self.line.problem or "the device has gone")

    # -- to override

    @abstractmethod
    def on_input(self, chunk: bytes) -> None:
        """Bytes came up the line."""

    def on_line(self, state: LineState) -> None:
        """The line was opened, is ready, or has gone."""

    # -- up the line

    def _line_is(self, state: LineState) -> None:
        if state is LineState.CLOSED:
            raise LinkError("the serial line's thread has ended")  # and so do we: the launcher starts us again
        self.on_line(state)

    def _take_in(self, chunk: bytes) -> None:
        """On the line's thread: one waiting job, however fast the MCU talks, so that commands are never crowded out."""
        with self._input_lock:
            if len(self._input) + len(chunk) > _INPUT_LIMIT:
                self.counters.add("input_dropped", len(self._input))
                self._input.clear()
                self._input += self.end  # what follows is no continuation of what was kept
            self._input += chunk
        self.post(self._read_input, newest_of="serial input")

    def _read_input(self) -> None:
        with self._input_lock:
            chunk = bytes(self._input)
            self._input.clear()
        self.on_input(chunk)

    def count_too_long(self, discarded: int) -> None:
        """Tell of lines that a splitter has thrown away, ``discarded`` of them so far."""
        too_long = discarded - self.counters["lines_discarded"]
        if too_long:
            self.counters.add("lines_discarded", too_long)
            self.chatter_log.warning("too long", "a line of the MCU was too long", times=too_long)
