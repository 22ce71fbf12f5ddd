"""The base of all bridges: it owns the serial line, and passes received bytes to the service's thread."""

import threading
import time
from abc import ABC, abstractmethod
from typing import Any, ClassVar

from pebble.config import SerialBridge
from pebble.contract import DRIVE
from pebble.contract.payloads import Drive
from pebble.errors import ConfigError, DeviceError
from pebble.runtime.notes import OFTEN
from pebble.runtime.parent import Notifier, Reported
from pebble.runtime.rate_limit import RateLimitedLog
from pebble.runtime.service import Service, every
from pebble.services.serial_mcu_bridge.line.holders import holders
from pebble.services.serial_mcu_bridge.line.serial_line import LineState, SerialLine
from pebble.services.serial_mcu_bridge.line.silence import CHECK_S, Silence
from pebble.services.serial_mcu_bridge.line.starts import Starts
from pebble.services.serial_mcu_bridge.moving_sensors import MovingSensors
from pebble.transports import Subscription
from pebble.transports.counters import in_words

_MISREAD = "what its board sends is not understood: another baud rate or firmware, or noise"
_WARN_S = 60.0
HOLDERS_S = 30.0  # between two looks for other programs at the device
_INPUT_LIMIT = 65_536  # bytes waiting for the service's thread; 1.4 s of a full 460,800 baud line


class SerialService(Service, ABC):
    """The service of a serial line. A subclass sets how its protocol uses the line, and parses received bytes."""

    name = "serial_mcu_bridge"
    end: ClassVar[bytes] = b"\n"  # of a text line, or a frame
    stop_line: ClassVar[bytes] = b""  # stops all motors; empty: the device has none
    receive_only: ClassVar[bool] = False  # nothing is ever sent
    boot_s: ClassVar[float] = 0.5  # input during so many seconds after opening is discarded
    retry_s: ClassVar[float] = 1.0  # the longest wait between two attempts to open the device

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        section = self.options
        if section.serial.port is None:
            raise ConfigError("services.serial_mcu_bridge.serial.port: required: ls /dev/serial/by-id/*")
        self.device_log = RateLimitedLog(self.log, burst=20)
        self._input = bytearray()
        self._input_lock = threading.Lock()
        self._silence, self._starts = Silence(), Starts()
        self.sensors = MovingSensors()
        self._sensor_problem = ""  # as last logged
        self._warned_at = float("-inf")  # of a board that starts again and again
        self._holders: list[str] = []  # other programs at the device
        self._misread = False  # at the last check bytes had come, and no report was understood
        self._heard = self._heard_opened = 0  # how many reports were understood, and in which opening of the line
        self._reported = Reported(Notifier().mcu)  # what report_mcu finds
        self.line = SerialLine(
            section.serial.port,
            section.serial.baud,
            stop=self.stop_line,
            on_bytes=self._queue_input,
            on_state=lambda state, _problem: self.post(lambda: self._on_line_state(state)),
            drive_timeout_s=section.safety.drive_timeout_seconds,
            boot_s=self.boot_s,
            retry_s=self.retry_s,
            end=b"" if self.receive_only else self.end,
        )

    def start(self) -> None:
        self.on_stop(self._close_line)
        self.line.open()

    @property
    def options(self) -> SerialBridge:
        """Config section of this serial line; with instances, the merged section of this instance."""
        return self.config.services.serial_mcu_bridge

    def follow_driving(self) -> Subscription:
        """Subscribe to drive commands, for a board that does not itself move the wheels.

        While they move the wheels, a sensor that never changes has failed.
        """

        def note(drive: Drive) -> None:
            self.sensors.drive(self.clock() + self.options.safety.drive_timeout_seconds if drive.moves else 0.0)

        return self.listen(DRIVE, note)

    # -- to override

    @abstractmethod
    def on_input(self, chunk: bytes) -> None:
        """Parse received bytes."""

    def on_line_state(self, state: LineState) -> None:
        """React to a serial line that was opened, is ready, or is gone."""

    def _close_line(self) -> None:
        self.line.close()
        logged, dropped = self.device_log.totals(), self.counters["input_dropped"]
        if logged or dropped:
            self.log.info("log lines of the MCU: %s; bytes dropped unread: %d", in_words(logged), dropped)

    def _on_line_state(self, state: LineState) -> None:
        if state is LineState.CLOSED:
            raise DeviceError("the serial line's thread has ended")  # so the process ends and the launcher restarts it
        self.report_mcu()
        self.on_line_state(state)

    def note_report(self, understood: bool) -> None:
        """Note a report; ``understood``: it belongs to the board's protocol, and is neither noise nor other text."""
        if understood:
            self._heard = self._heard_since_opening() + 1
            self._heard_opened = self.line.opened

    def _heard_since_opening(self) -> int:
        return self._heard if self._heard_opened == self.line.opened else 0

    def note_start(self) -> None:
        """Note that the board has started; it is a restart if earlier reports came since the line was opened."""
        if self._heard_since_opening() > 1:  # the report of this start is one of them
            self._starts.began(time.monotonic())

    def note_clock(self, mcu_ms: int) -> None:
        """Note the board's 32-bit clock ``mcu_ms``: if it goes back, the board has started again."""
        self._starts.sent(self.line.opened, mcu_ms, time.monotonic())

    @every(CHECK_S)
    def report_mcu(self) -> None:
        """Report changes of the MCU to the launcher."""
        line, now = self.line, time.monotonic()  # the line's clock
        if line.state is LineState.CLOSED:
            return
        idle, heard = now - line.output.sent_until >= CHECK_S, self._heard_since_opening()
        state, silent_ms = self._silence.check(line.state, line.opened, heard, now, idle=idle)
        # Bytes have come since the line was opened, but no report was understood: then ``silent_ms`` is None.
        misread = silent_ms is None and line.state is LineState.READY and line.received > 0
        sensor_problem = self.sensors.problem
        if sensor_problem and not self._sensor_problem:
            self.log.warning("%s", sensor_problem)
        self._sensor_problem = sensor_problem
        starts = self._starts.within_a_minute(line.opened, now)
        misread_twice = misread and self._misread  # once proves nothing: the first report may be under way
        problem = _MISREAD if misread_twice else line.problem or sensor_problem
        self._misread = misread
        self._reported.report(state, silent_ms, problem, starts)
        if starts >= OFTEN and now - self._warned_at >= _WARN_S:
            self._warned_at = now
            text = "the board has started again %d times within a minute: its supply breaks down, or its cable is loose"
            self.log.warning(text, starts)

    @every(HOLDERS_S)
    def name_holders(self) -> None:
        """Warn of other programs that have this device open, which is possible although we have locked it."""
        if self.line.state in (LineState.BOOTING, LineState.READY):
            threading.Thread(target=self._name_holders, name="holders", daemon=True).start()  # it takes a while

    def _name_holders(self) -> None:
        path = str(self.options.serial.port)
        others = holders(path)
        if others and others != self._holders:
            text = "%s is open in another program, too: %s; two confuse the board: end that one"
            self.log.warning(text, path, ", ".join(others))
        self._holders = others

    def _queue_input(self, chunk: bytes) -> None:
        """Queue input on the reading thread; if the service is idle, parse it there as well.

        At most one job waits, however much the MCU sends, so that commands are not delayed.
        """
        with self._input_lock:
            if len(self._input) + len(chunk) > _INPUT_LIMIT:
                self.counters.add("input_dropped", len(self._input))
                self._input.clear()
                self._input += self.end  # what follows does not continue the text line before the gap
            self._input += chunk
        if not self.run_if_idle(self._read_input):
            self.post(self._read_input, newest_of="serial input")

    def _read_input(self) -> None:
        with self._input_lock:
            chunk = bytes(self._input)
            self._input.clear()
        self.on_input(chunk)

    def count_discarded(self, discarded: int) -> None:
        """Count and log discarded text lines; ``discarded``: their number so far."""
        too_long = discarded - self.counters["lines_discarded"] if discarded else 0
        if too_long:
            self.counters.add("lines_discarded", too_long)
            self.device_log.warning("too long", "a line of the MCU was too long", times=too_long)
