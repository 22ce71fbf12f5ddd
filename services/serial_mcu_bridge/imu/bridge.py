"""The bridge of an inertial sensor with ``imu_mpu6050_v1``: publishes its samples on ``sensors/imu*``."""

import logging
import time
from typing import Any

from pebble.contract import IMU, IMU_FAST
from pebble.errors import DeviceError
from pebble.runtime.lines import LineSplitter
from pebble.runtime.service import every
from pebble.services.serial_mcu_bridge.imu.mpu6050 import Motion, Report, Summary, parse
from pebble.services.serial_mcu_bridge.imu.reports import ImuReports, ImuWatchdog, measured
from pebble.services.serial_mcu_bridge.line.serial_line import LineState
from pebble.services.serial_mcu_bridge.serial_service import SerialService
from pebble.services.serial_mcu_bridge.text.device_log import DeviceLogLine, is_known

_WATCH_S = 0.5


class ImuBridge(SerialService):
    """The service of a sensor, to which it sends nothing. Samples must change while drive commands move the wheels."""

    receive_only = True

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._watchdog = ImuWatchdog(self.options, self.instance)
        self._splitter = LineSplitter()
        self._reports = ImuReports(self.options, self.instance)

    def set_up(self) -> None:
        super().set_up()
        self.follow_driving()

    def on_line_state(self, state: LineState) -> None:
        if state is LineState.BOOTING:
            self._splitter.reset()
        elif state is LineState.READY:
            self._watchdog.begin(self.clock())
        else:
            self._watchdog.end()

    def on_input(self, chunk: bytes) -> None:
        for line in self._splitter.feed(chunk):
            report = parse(line)
            if report is not None:
                self.note_report(is_known(report))
                self._report(report)
        self.count_discarded(self._splitter.discarded_lines)

    @every(_WATCH_S)
    def watch(self) -> None:
        if self._watchdog.expired(self.clock()):
            raise DeviceError(f"no sample for {self._watchdog.timeout_s:g} s")

    def _report(self, report: Report) -> None:
        now_ms = time.time_ns() // 1_000_000
        match report:
            case Motion(number, mcu_ms, values):
                self._watchdog.sample(self.clock())
                self.sensors.take(measured(values), self.clock())
                self.note_clock(mcu_ms)
                self.publish(IMU_FAST, self._reports.motion(now_ms, number, mcu_ms, values))
            case Summary(number, mcu_ms, values):
                summary = self._reports.summary(now_ms, number, mcu_ms, values)
                if summary is not None:
                    self.publish(IMU, summary)
            case DeviceLogLine(level, text):
                subject = "malformed" if level == logging.WARNING else "log"  # `parse` warns of nothing else
                self.device_log.log(subject, level, "MCU: %s", text)
