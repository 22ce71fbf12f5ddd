"""Fred's motor board: two motors, an RGB light, three touch pads; commanded over USB by goob_base_v1."""

import time

from machine import ADC, PWM, Pin
from micropython import const

from common.deadman import DeadMan
from common.light import Light
from common.lines import Lines, clamp
from common.ticks import Grid
from fred import pins
from fred.gears import Gears

try:
    from common.usb import Port
except ImportError:  # the official image of the board lacks select and sys.stdin.buffer
    from common.console import Port  # type: ignore[assignment]

_FAILSAFE_MS = const(1000)
_SENSORS_MS = const(500)
_FADE_MS = const(20)
_AT_ONCE = const(32)  # bytes from the host per turn: a flood must not delay the failsafe
_DRIVE = const(77)  # M
_GLOW = const(76)  # L


class Motor:
    """A half of a DRV8833. ``pins`` = (in1, in2) share a timer channel; only the driven pin is connected to it.

    The released pin is an output at 0 again (ports/samd/machine_pwm.c, mp_machine_pwm_deinit). The class is in this
    file because another file costs 350 bytes of RAM.
    """

    def __init__(self, pins: tuple[str, str], freq_hz: int) -> None:
        self._pins = [Pin(pin, Pin.OUT, value=0) for pin in pins]
        self._freq = freq_hz
        self._pwm: PWM | None = None
        self._duty = 0

    def set(self, speed: float) -> None:
        """Turn at ``speed``, -1..1; + drives in1."""
        duty = int(speed * 65535)
        if duty == self._duty:
            return
        if not duty or duty ^ self._duty < 0:  # it stops, or turns the other way
            self.stop()
        self._duty = duty
        if self._pwm:
            self._pwm.duty_u16(abs(duty))
        elif duty:  # ahead by in1, backwards by in2
            self._pwm = PWM(self._pins[duty < 0], freq=self._freq, duty_u16=abs(duty))

    def stop(self) -> None:
        self._duty = 0
        if self._pwm:
            self._pwm.deinit()
            self._pwm = None


class Robot:
    """The board. Call ``step`` often; every turn checks the failsafe first."""

    def __init__(self) -> None:
        # before anything else: motors off; PWM is made in the order of pins.py: red, green, blue, last the motors'
        self._left, self._right = Motor(pins.LEFT, pins.PWM_HZ), Motor(pins.RIGHT, pins.PWM_HZ)
        red, green, blue = [PWM(Pin(pin, Pin.OUT, value=0), freq=pins.PWM_HZ, duty_u16=0) for pin in reversed(pins.LED)]
        self._led = (blue, green, red)  # as in pins.LED
        self._now = now = time.ticks_ms()
        self.deadman = DeadMan(_FAILSAFE_MS)
        self.gears = Gears()
        self.light = Light(now)
        self.lines = Lines(self._act)
        self.port = Port(self.lines)
        self._sensors = [ADC(Pin(pin)) for pin in pins.SENSORS]
        self._charge = Pin(pins.CHARGE, Pin.IN, Pin.PULL_DOWN)
        self._sensors_grid, self._fade_grid = Grid(_SENSORS_MS, now), Grid(_FADE_MS, now)  # when they are due
        self._level = -1  # of the light, as set last; -1: it has to be set
        self.lines.put(b"Starting setup...")
        self.lines.put(b"Done!")

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
        if self._fade_grid.due(now):
            self._shine(now)
        if self._sensors_grid.due(now):
            t0, t1, t2 = self._sensors
            values = (t0.read_u16() >> 6, t1.read_u16() >> 6, t2.read_u16() >> 6, self._charge.value())
            lines.put(b"T t0=%d t1=%d t2=%d chg=%d" % values)
        port.send()

    def stop(self) -> None:
        self._left.stop()
        self._right.stop()

    def _act(self, letter: int, numbers: list[float]) -> None:
        if letter == _DRIVE:
            self.deadman.feed(self._now)
            left, right = self.gears.limit(clamp(numbers[0], -1.0), clamp(numbers[1], -1.0), self._now)
            self._left.set(left)
            self._right.set(right)
            return
        blue, green, red = clamp(numbers[0], 0.0), clamp(numbers[1], 0.0), clamp(numbers[2], 0.0)
        if letter == _GLOW:
            self.light.glow(blue, green, red)
        else:
            self.light.flash(blue, green, red, numbers[3], self._now)
        self._level = -1  # the colour is new, even if the brightness is not
        self._shine(self._now)

    def _shine(self, now: int) -> None:
        level = self.light.level(now)
        if level == self._level:
            return
        self._level = level
        for index in range(3):
            self._led[index].duty_u16(int(self.light.colour[index] * 65535) * level // 512)


def build(_settings: dict) -> Robot:
    return Robot()
