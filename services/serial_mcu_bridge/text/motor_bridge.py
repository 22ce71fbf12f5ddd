"""The bridge of a motor MCU: sends drive and lights commands, publishes sensor reports."""

from __future__ import annotations

import logging
from functools import cached_property
from typing import Any, ClassVar, Protocol

from pebble import contract as c
from pebble.contract.groups import Member
from pebble.contract.payloads import (
    ChargingLevel,
    ChargingStatus,
    Drive,
    LightsFlash,
    LightsSolid,
    MotorPower,
    TouchSensors,
    TouchValues,
)
from pebble.motors.motor_owner import MotorOwner
from pebble.runtime.lines import LineSplitter
from pebble.runtime.service import on
from pebble.services.serial_mcu_bridge.line.serial_line import LineState
from pebble.services.serial_mcu_bridge.serial_service import SerialService
from pebble.services.serial_mcu_bridge.text import goob_base
from pebble.services.serial_mcu_bridge.text.device_log import DeviceLogLine, is_known
from pebble.services.serial_mcu_bridge.text.goob_base import Charging, Level, Report, Touch
from pebble.services.serial_mcu_bridge.text.hall_memory import HallMemory

_AGAIN_S = 0.5  # while motors run, for an odometry that began after them
_LIGHTS = "lights"  # a steady colour and a fade replace one another


class MotorProtocol(Protocol):
    """The functions of a text protocol that drives motors; a module can be one, as goob_base is."""

    def parse(self, line: bytes) -> list[Report]: ...
    def mix(self, x: float, z: float) -> tuple[float, float]: ...
    def drive_line(self, left: float, right: float) -> bytes: ...
    def lights_line(self, blue: float, green: float, red: float) -> bytes: ...
    def flash_line(self, blue: float, green: float, red: float, period_s: float) -> bytes: ...


class MotorBridge(MotorOwner, SerialService):
    """A motor board on a serial line, as a motor owner.

    SerialLine sends the stop line when it opens, and in close(), which :meth:`on_stop` calls.

    A bridge of another text protocol sets ``protocol`` and ``stop_line``.
    """

    company = (c.LIGHTS_SOLID, c.LIGHTS_FLASH)
    protocol: ClassVar[MotorProtocol] = goob_base
    stop_line = goob_base.STOP

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._publishes_touch = self.options.telemetry.publish_touch_sensors
        self._power, self._again_at = (0.0, 0.0), 0.0  # (left, right) as published last, and when it is due again
        self._charging: ChargingStatus | None = None  # as published last: it is published only when it changes
        memory = self.config.hall_memory(self.options)
        self._hall = None if memory is None else HallMemory(memory)
        self._splitter = LineSplitter()

    @cached_property
    def owner(self) -> str:
        return self.config.motor_owner(self.instance)

    @property
    def drive_timeout_s(self) -> float:
        return self.options.safety.drive_timeout_seconds

    def start(self) -> None:
        if self._hall is not None:
            self.on_stop(self._hall.close)
        super().start()

    def move(self, drive: Drive, valid_s: float) -> None:
        power = self.protocol.mix(drive.x, drive.z)
        self.line.drive(self.protocol.drive_line(*power), valid_s)
        self._note_power(*power, valid_s)

    def move_with(self, drive: Drive, valid_s: float, company: tuple[Member, ...]) -> None:
        power = self.protocol.mix(drive.x, drive.z)
        line = self.protocol.drive_line(*power) if drive.moves else self.stop_line
        valid_s = valid_s if drive.moves else float("inf")
        self.line.drive(line + self._lights_line(company[0].value), valid_s, replaces=_LIGHTS)
        self._note_power(*power, valid_s)

    def accompany(self, company: tuple[Member, ...]) -> None:
        self.line.send(_LIGHTS, self._lights_line(company[0].value))

    def _note_power(self, left: float, right: float, valid_s: float) -> None:
        self.sensors.drive(self.clock() + valid_s if left and right else 0.0)  # all must change only if both turn
        self._show_power(left, right)

    def halt(self) -> None:
        self.line.halt()
        self.sensors.drive(0.0)
        self._show_power(0.0, 0.0)

    def _show_power(self, left: float, right: float) -> None:
        """Publish the power that the wheels are commanded, for odometry: each change, and again while not zero."""
        now = self.clock()
        if self._publishes_touch and ((left, right) != self._power or ((left or right) and now >= self._again_at)):
            self._power, self._again_at = (left, right), now + _AGAIN_S
            self.publish(c.MOTOR_POWER, MotorPower(left=left, right=right), owner=self.owner)

    @on(c.LIGHTS_SOLID)
    def lights_solid(self, colour: LightsSolid) -> None:
        if not self.is_copy(colour):
            self.line.send(_LIGHTS, self._lights_line(colour))

    @on(c.LIGHTS_FLASH)
    def lights_flash(self, colour: LightsFlash) -> None:
        self.lights_solid(colour)

    def _lights_line(self, colour: LightsSolid) -> bytes:
        if isinstance(colour, LightsFlash):
            return self.protocol.flash_line(colour.b, colour.g, colour.r, colour.period)
        return self.protocol.lights_line(colour.b, colour.g, colour.r)

    def on_line_state(self, state: LineState) -> None:
        if state is LineState.BOOTING:
            self._splitter.reset()

    def on_input(self, chunk: bytes) -> None:
        for line in self._splitter.feed(chunk):
            reports = self.protocol.parse(line)
            for report in reports:
                self.note_report(is_known(report))
                self._report(report)
            if self._hall is not None:
                self._keep_samples(self._hall, reports)  # last, as it needs what this line says of the charger
        self.count_discarded(self._splitter.discarded_lines)

    def _keep_samples(self, hall: HallMemory, reports: list[Report]) -> None:
        charging = None if self._charging is None else self._charging.value
        for report in reports:
            if isinstance(report, Touch):
                hall.write(round(self.clock() * 1e9), (report.a0, report.a1, report.a2), charging)

    def _report(self, report: Report) -> None:
        match report:
            case Touch(a0, a1, a2, of_wheels=of_wheels):
                if of_wheels:
                    self.sensors.take({"hall sensor a0": a0, "hall sensor a1": a1, "hall sensor a2": a2}, self.clock())
                if self._publishes_touch:
                    self.publish(c.TOUCH_SENSORS, TouchSensors(value=TouchValues(a0=a0, a1=a1, a2=a2)))
            case Charging(value):
                status = ChargingStatus(value=value)
                if status != self._charging:
                    self._charging = status
                    self.publish(c.CHARGING_STATUS, status)
            case Level(volts):
                self.publish(c.CHARGING_LEVEL, ChargingLevel(value=volts))
            case DeviceLogLine(level, text):
                self.device_log.log(logging.getLevelName(level), level, "MCU: %s", text)
                if text.partition(" ")[0].endswith(goob_base.STARTED):  # noise may be before it
                    self.note_start()
