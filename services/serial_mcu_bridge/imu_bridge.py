"""Owns the serial line to an inertial sensor that speaks ``imu_mpu6050_v1``: its samples become ``sensors/imu*``."""

from __future__ import annotations

import logging
import time

from pebble.contract import IMU, IMU_FAST
from pebble.errors import LinkError
from pebble.service import every
from pebble.services.serial_mcu_bridge.imu import ImuReports
from pebble.services.serial_mcu_bridge.imu_mpu6050 import Chatter, Motion, Report, Summary, parse
from pebble.services.serial_mcu_bridge.imu_watchdog import ImuWatchdog
from pebble.services.serial_mcu_bridge.line import LineState
from pebble.services.serial_mcu_bridge.serial_service import SerialService
from pebble.services.serial_mcu_bridge.splitter import LineSplitter

_WATCH_S = 0.5


class ImuBridge(SerialService):
    """Listens only: nothing is ever sent to the sensor."""

    publishes = (IMU_FAST, IMU)

    def start(self) -> None:
        self._watchdog = ImuWatchdog(self.options, self.instance)
        self._splitter = LineSplitter()
        self._reports = ImuReports(
            device=str(self.options.serial.port), protocol=self.options.protocol, instance=self.instance
        )
        self.open_line()

    def on_line(self, state: LineState) -> None:
        if state is LineState.SETTLING:
            self._splitter.reset()
        elif state is LineState.READY:
            self._watchdog.begin(time.monotonic())
        else:
            self._watchdog.end()
            self.exit_if_asked()

    def on_input(self, chunk: bytes) -> None:
        for line in self._splitter.feed(chunk):
            report = parse(line)
            if report is not None:
                self._report(report)
        self.count_too_long(self._splitter.discarded_lines)

    @every(_WATCH_S)
    def watch(self) -> None:
        if self._watchdog.expired(time.monotonic()):
            raise LinkError(f"no sample for {self._watchdog.timeout_s:g} s")

    def _report(self, report: Report) -> None:
        now_ms = time.time_ns() // 1_000_000
        match report:
            case Motion(number, mcu_ms, values):
                self._watchdog.sample(time.monotonic())
                self.publish(IMU_FAST, self._reports.motion(now_ms, number, mcu_ms, values))
            case Summary(number, mcu_ms, values):
                summary = self._reports.summary(now_ms, number, mcu_ms, values)
                if summary is not None:
                    self.publish(IMU, summary)
            case Chatter(text, odd):
                level = logging.WARNING if odd else logging.INFO
                self.chatter_log.say("odd" if odd else "said", level, "MCU: %s", text)
