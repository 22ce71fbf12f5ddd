"""Goob's motor board: two motors, headlights, hall sensors, battery; commanded over USB by goob_base_v1."""

import time

from machine import ADC, PWM, Pin
from micropython import const

from common.deadman import DeadMan
from common.drv8833 import Motor
from common.light import Light
from common.lines import Lines, clamp
from common.ticks import Grid
from goob import pins

try:
    from common.usb import Port
except ImportError:  # the official image of the board lacks select and sys.stdin.buffer
    from common.console import Port  # type: ignore[assignment]

_FAILSAFE_MS = const(1000)
_SENSORS_MS = const(20)
_BATTERY_MS = const(5000)
_AT_ONCE = const(32)  # bytes from the host per turn: a flood must not delay the failsafe
_DRIVE = const(77)  # M
_GLOW = const(76)  # L


class Robot:
    """The board. Call ``step`` often; every turn checks the failsafe first."""

    def __init__(self) -> None:
        # before anything else: motors off; the order is that of pins.py
        self._right = Motor(pins.RIGHT, pins.PWM_HZ)
        self._led = PWM(Pin(pins.LED, Pin.OUT, value=0), freq=pins.PWM_HZ, duty_u16=0)
        self._left = Motor(pins.LEFT, pins.PWM_HZ)
        self._now = now = time.ticks_ms()
        self.deadman = DeadMan(_FAILSAFE_MS)
        self.light = Light(now)
        self.lines = Lines(self._act)
        self.port = Port(self.lines)
        self._sensors = [ADC(Pin(pin)) for pin in pins.SENSORS]
        self._battery = ADC(Pin(pins.BATTERY))
        self._full_mv = int(pins.BATTERY_FULL_V * 1000)
        self._sensors_grid, self._battery_grid = Grid(_SENSORS_MS, now), Grid(_BATTERY_MS, now)  # when they are due
        self._duty = 0  # of the headlights, as set last
        self.lines.put(b"Starting setup...")
        self.lines.put(b"Done!")
        self._report_battery()

    def step(self) -> None:
        self._now = now = time.ticks_ms()
        if self.deadman.expired(now):
            self.stop()
        port, lines = self.port, self.lines
        for _ in range(_AT_ONCE):
            byte = port.read()
            if byte < 0:
                lines.rest(now)  # drops an unfinished line, after a while
                break
            lines.take(byte)
            port.send()  # now, too: the ring has no room for the answers to many short lines
        if self._sensors_grid.due(now):
            a0, a1, a2 = self._sensors
            lines.put(b"T a0=%d a1=%d a2=%d" % (a0.read_u16() >> 6, a1.read_u16() >> 6, a2.read_u16() >> 6))
            self._shine(now)
        if self._battery_grid.due(now):
            self._report_battery()
        port.send()

    def stop(self) -> None:
        self._left.stop()
        self._right.stop()

    def _act(self, letter: int, numbers: list[float]) -> None:
        if letter == _DRIVE:
            self.deadman.feed(self._now)
            self._left.set(clamp(numbers[0], -1.0))
            self._right.set(-clamp(numbers[1], -1.0))  # mounted the other way round
            return
        blue, green, red = clamp(numbers[0], 0.0), clamp(numbers[1], 0.0), clamp(numbers[2], 0.0)
        if letter == _GLOW:
            self.light.glow(blue, green, red)
        else:
            self.light.flash(blue, green, red, numbers[3], self._now)
        self._shine(self._now)

    def _shine(self, now: int) -> None:
        """Set the white headlights to the brightest component of the colour."""
        duty = int(max(self.light.colour) * 65535) * self.light.level(now) // 512
        if duty != self._duty:
            self._duty = duty
            self._led.duty_u16(duty)

    def _report_battery(self) -> None:
        millivolts = (self._battery.read_u16() * self._full_mv + 32767) // 65535
        self.lines.put(b"C chg=-1 v=%d.%03d" % (millivolts // 1000, millivolts % 1000))


def build(_settings: dict) -> Robot:
    return Robot()
