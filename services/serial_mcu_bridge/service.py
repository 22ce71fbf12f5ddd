"""Owns the serial line to one MCU: drive and lights commands go down it, sensor reports come up."""

from __future__ import annotations

import logging
import threading
import time

from pebble.contract import CHARGING_LEVEL, CHARGING_STATUS, DRIVE, LIGHTS_FLASH, LIGHTS_SOLID, TOUCH_SENSORS
from pebble.errors import ConfigError, LinkError
from pebble.payloads import (
    ChargingLevel,
    ChargingStatus,
    Drive,
    LightsFlash,
    LightsSolid,
    TouchSensors,
    TouchValues,
)
from pebble.rate_limit import RateLimitedLog
from pebble.service import Service, on
from pebble.services.serial_mcu_bridge.goob_base import Charging, Chatter, Level, Report, Touch
from pebble.services.serial_mcu_bridge.line import LineState, SerialLine
from pebble.services.serial_mcu_bridge.protocols import PROTOCOLS
from pebble.services.serial_mcu_bridge.splitter import LineSplitter

_INPUT_LIMIT = 65_536  # bytes waiting for the service's thread; 1.4 s of a full 460,800 baud line
_LIGHTS = "lights"  # a steady colour and a fade replace one another


class SerialMcuBridge(Service):
    """Whatever happens, the motors stop: without a command for ``drive_timeout_seconds``, at the start, at the end."""

    name = "serial_mcu_bridge"
    publishes = (TOUCH_SENSORS, CHARGING_STATUS, CHARGING_LEVEL)

    def start(self) -> None:
        options = self.config.services.serial_mcu_bridge
        if options.protocol not in PROTOCOLS:
            known = ", ".join(PROTOCOLS)
            raise ConfigError(f'services.serial_mcu_bridge.protocol: "{options.protocol}" is not here yet; use {known}')
        if options.serial.port is None:
            raise ConfigError("services.serial_mcu_bridge.serial.port: required, for example /dev/ttyACM0")
        self._protocol = PROTOCOLS[options.protocol]
        self._timeout_s = options.safety.drive_timeout_seconds
        self._touch_wanted = options.telemetry.publish_touch_sensors
        self._deadline: float | None = None  # when the wheels stop unless a command comes; None while they stand
        self._charging: ChargingStatus | None = None
        self._splitter = LineSplitter()
        self._chatter_log = RateLimitedLog(self.log, burst=20)
        self._input = bytearray()
        self._input_lock = threading.Lock()
        self._line = SerialLine(
            options.serial.port,
            options.serial.baud,
            stop=self._protocol.STOP,
            on_bytes=self._take_in,
            on_state=lambda state, _problem: self.post(lambda: self._line_is(state)),
            drive_timeout_s=self._timeout_s,
            read_timeout_s=options.serial.timeout_seconds,
        )
        self._line.open()

    def stop(self) -> None:
        if hasattr(self, "_line"):
            self._line.close()
            chatter, dropped = self._chatter_log.totals(), self.counters["input_dropped"]
            if chatter or dropped:
                self.log.info("lines of the MCU that were no report: %s; bytes dropped unread: %d", chatter, dropped)

    @property
    def republish_interval_s(self) -> float:
        return self.config.services.serial_mcu_bridge.retained_publish_interval_seconds

    # -- down the line

    @on(DRIVE)
    def drive(self, wanted: Drive) -> None:
        now = time.monotonic()
        if self._deadline is not None and now >= self._deadline:
            self._line.halt()  # the watchdog is late, as we are: what was driven last ended before this begins
        self._line.drive(self._protocol.drive_line(*self._protocol.mix(wanted.x, wanted.z)))
        if self._deadline is None:
            self.call_at(now + self._timeout_s, self._watch)
        self._deadline = now + self._timeout_s

    @on(LIGHTS_SOLID)
    def shine(self, colour: LightsSolid) -> None:
        self._line.send(_LIGHTS, self._protocol.lights_line(colour.b, colour.g, colour.r))

    @on(LIGHTS_FLASH)
    def flash(self, colour: LightsFlash) -> None:
        self._line.send(_LIGHTS, self._protocol.flash_line(colour.b, colour.g, colour.r, colour.period))

    def _watch(self) -> None:
        """The watchdog: stop once the last command is too old, or look again when it would be."""
        if self._deadline is None:
            return
        if time.monotonic() < self._deadline:
            self.call_at(self._deadline, self._watch)
            return
        self._deadline = None
        self._line.halt()

    # -- up the line

    def _line_is(self, state: LineState) -> None:
        if state is LineState.SETTLING:
            self._splitter.reset()
        elif state is LineState.CLOSED:
            raise LinkError("the serial line's thread has ended")  # and so do we: the launcher starts us again

    def _take_in(self, chunk: bytes) -> None:
        """On the line's thread: one waiting job, however fast the MCU talks, so that commands are never crowded out."""
        with self._input_lock:
            if len(self._input) + len(chunk) > _INPUT_LIMIT:
                self.counters.add("input_dropped", len(self._input))
                self._input.clear()
                self._input += b"\n"  # what follows is no continuation of what was kept
            self._input += chunk
        self.post(self._read_input, newest_of="serial input")

    def _read_input(self) -> None:
        with self._input_lock:
            chunk = bytes(self._input)
            self._input.clear()
        for line in self._splitter.feed(chunk):
            for report in self._protocol.parse(line):
                self._report(report)
        too_long = self._splitter.discarded_lines - self.counters["lines_discarded"]
        if too_long:
            self.counters.add("lines_discarded", too_long)
            self._chatter_log.warning("too long", "a line of the MCU was too long", times=too_long)

    def _report(self, report: Report) -> None:
        match report:
            case Touch(a0, a1, a2):
                if self._touch_wanted:
                    self.publish(TOUCH_SENSORS, TouchSensors(value=TouchValues(a0=a0, a1=a1, a2=a2)))
            case Charging(value):
                self._say_charging(ChargingStatus(value=value))
            case Level(volts):
                self.publish(CHARGING_LEVEL, ChargingLevel(value=volts))
            case Chatter(level, text):
                self._chatter_log.say(logging.getLevelName(level), level, "MCU: %s", text)

    def _say_charging(self, status: ChargingStatus) -> None:
        if status != self._charging:
            self._charging = status
            self.publish(CHARGING_STATUS, status)
