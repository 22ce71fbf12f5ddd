"""Owns the serial line to a motor MCU: drive and lights commands go down it, sensor reports come up."""

from __future__ import annotations

import logging
import time

from pebble.contract import CHARGING_LEVEL, CHARGING_STATUS, DRIVE, LIGHTS_FLASH, LIGHTS_SOLID, TOUCH_SENSORS
from pebble.payloads import (
    ChargingLevel,
    ChargingStatus,
    Drive,
    LightsFlash,
    LightsSolid,
    TouchSensors,
    TouchValues,
)
from pebble.service import on
from pebble.services.serial_mcu_bridge.goob_base import Charging, Chatter, Level, Report, Touch
from pebble.services.serial_mcu_bridge.line import LineState
from pebble.services.serial_mcu_bridge.protocols import PROTOCOLS
from pebble.services.serial_mcu_bridge.serial_service import SerialService
from pebble.services.serial_mcu_bridge.splitter import LineSplitter

_LIGHTS = "lights"  # a steady colour and a fade replace one another


class SerialMcuBridge(SerialService):
    """Whatever happens, the motors stop: without a command for ``drive_timeout_seconds``, at the start, at the end."""

    publishes = (TOUCH_SENSORS, CHARGING_STATUS, CHARGING_LEVEL)

    def start(self) -> None:
        options = self.options
        self._protocol = PROTOCOLS[options.protocol]
        self._timeout_s = options.safety.drive_timeout_seconds
        self._touch_wanted = options.telemetry.publish_touch_sensors
        self._deadline: float | None = None  # when the wheels stop unless a command comes; None while they stand
        self._charging: ChargingStatus | None = None
        self._splitter = LineSplitter()
        self.open_line(stop=self._protocol.STOP)

    # -- down the line

    @on(DRIVE)
    def drive(self, wanted: Drive) -> None:
        now = time.monotonic()
        if self._deadline is not None and now >= self._deadline:
            self.line.halt()  # the watchdog is late, as we are: what was driven last ended before this begins
        self.line.drive(self._protocol.drive_line(*self._protocol.mix(wanted.x, wanted.z)))
        if self._deadline is None:
            self.call_at(now + self._timeout_s, self._watch)
        self._deadline = now + self._timeout_s

    @on(LIGHTS_SOLID)
    def shine(self, colour: LightsSolid) -> None:
        self.line.send(_LIGHTS, self._protocol.lights_line(colour.b, colour.g, colour.r))

    @on(LIGHTS_FLASH)
    def flash(self, colour: LightsFlash) -> None:
        self.line.send(_LIGHTS, self._protocol.flash_line(colour.b, colour.g, colour.r, colour.period))

    def _watch(self) -> None:
        """The watchdog: stop once the last command is too old, or look again when it would be."""
        if self._deadline is None:
            return
        if time.monotonic() < self._deadline:
            self.call_at(self._deadline, self._watch)
            return
        self._deadline = None
        self.line.halt()

    # -- up the line

    def on_line(self, state: LineState) -> None:
        if state is LineState.SETTLING:
            self._splitter.reset()

    def on_input(self, chunk: bytes) -> None:
        for line in self._splitter.feed(chunk):
            for report in self._protocol.parse(line):
                self._report(report)
        self.count_too_long(self._splitter.discarded_lines)

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
                self.chatter_log.say(logging.getLevelName(level), level, "MCU: %s", text)

    def _say_charging(self, status: ChargingStatus) -> None:
        if status != self._charging:
            self._charging = status
            self.publish(CHARGING_STATUS, status)
