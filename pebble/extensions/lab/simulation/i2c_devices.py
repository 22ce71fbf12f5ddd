"""Simulated I2C devices: the MPU-6050, with its registers and sensors, and the WEMOS D1 mini motor shield v1.0.0.

The MPU's registers, scales and reset values are those of InvenSense RM-MPU-6000A-00 4.2; its noise is from the data
sheet.
"""

import math
import random
import struct
from collections.abc import Callable
from typing import Final

from pebble.extensions.lab.simulation.motion import RobotMotion

_GYRO_CONFIG, _ACCEL_CONFIG, _ACCEL_XOUT_H, _PWR_MGMT_1, _WHO_AM_I = 0x1B, 0x1C, 0x3B, 0x6B, 0x75
_SLEEP = 0x40
_G_MM_S2: Final = 9806.65
_ACCEL_LSB_PER_G, _GYRO_LSB_PER_DPS = 16_384.0, 131.0  # at the smallest range; each further range halves them
_ACCEL_NOISE_G, _GYRO_NOISE_DPS = 0.004, 0.05  # rms with the low-pass filter at 94 Hz
_CELSIUS = 31.0  # it heats itself

Vector = tuple[float, float, float]


class Mpu6050:
    """An MPU-6050 that lies flat, z up, x ahead, and follows ``motion`` if given. ``tilt_deg`` is (roll, pitch).

    ``bias_dps`` is the gyroscope's reading at rest. ``now`` returns the time in seconds of any clock.
    """

    def __init__(self, now: Callable[[], float], motion: RobotMotion | None = None) -> None:
        self.tilt_deg = (0.0, 0.0)
        self.bias_dps: Vector = (1.2, -0.8, 0.45)
        self._now, self._motion = now, motion
        self._noise = random.Random(1)  # noqa: S311 - repeatable
        self._moved_at, self._speed_mm_s = now(), 0.0  # the last sample's time, and the speed then
        self._pointer = 0  # the register that is read next
        self._registers = bytearray(128)  # asleep, at the smallest ranges
        self._registers[_PWR_MGMT_1] = _SLEEP
        self._registers[_WHO_AM_I] = 0x68

    # -- the bus

    def write(self, data: bytes) -> None:
        if not data:
            return
        self._pointer = data[0]
        for offset, value in enumerate(data[1:]):
            register = (data[0] + offset) % 128
            if register != _WHO_AM_I:  # which cannot be written
                self._registers[register] = value

    def read(self, count: int) -> bytes:
        if not self._registers[_PWR_MGMT_1] & _SLEEP:
            self._registers[_ACCEL_XOUT_H : _ACCEL_XOUT_H + 14] = self._sample()
        values = bytes(self._registers[(self._pointer + offset) % 128] for offset in range(count))
        self._pointer = (self._pointer + count) % 128
        return values

    # -- the sensors

    def _sample(self) -> bytes:
        """Return acceleration, temperature and angular rate as the 14 data registers hold them."""
        accel, gyro = self._true_values()
        per_g = _ACCEL_LSB_PER_G / (1 << (self._registers[_ACCEL_CONFIG] >> 3 & 3))
        per_dps = _GYRO_LSB_PER_DPS / (1 << (self._registers[_GYRO_CONFIG] >> 3 & 3))
        return struct.pack(
            ">7h",
            *(_int16((part + self._noise.gauss(0.0, _ACCEL_NOISE_G)) * per_g) for part in accel),
            _int16((_CELSIUS - 36.53) * 340.0),
            *(_int16((part + self._noise.gauss(0.0, _GYRO_NOISE_DPS)) * per_dps) for part in gyro),
        )

    def _true_values(self) -> tuple[Vector, Vector]:
        """Return specific force in g (1 g upwards at rest), and angular rate in degrees per second."""
        roll, pitch = (math.radians(angle) for angle in self.tilt_deg)
        ahead, aside, turn_dps = self._motion_values()
        accel = (
            -math.sin(pitch) + ahead,
            math.sin(roll) * math.cos(pitch) + aside,
            math.cos(roll) * math.cos(pitch),
        )
        bias_x, bias_y, bias_z = self.bias_dps
        return accel, (bias_x, bias_y, bias_z + turn_dps)

    def _motion_values(self) -> tuple[float, float, float]:
        """Return the motion's part: acceleration ahead and to the left in g, and angular rate to the left."""
        if self._motion is None:
            return 0.0, 0.0, 0.0
        now = self._now()
        speed = (self._motion.left_mm_s + self._motion.right_mm_s) / 2
        turn_rad_s = (self._motion.right_mm_s - self._motion.left_mm_s) / self._motion.wheels.track_mm
        seconds = now - self._moved_at
        ahead = (speed - self._speed_mm_s) / seconds / _G_MM_S2 if seconds > 0.0 else 0.0
        self._moved_at, self._speed_mm_s = now, speed
        return ahead, speed * turn_rad_s / _G_MM_S2, math.degrees(turn_rad_s)


def _int16(value: float) -> int:
    return max(-32_768, min(32_767, round(value)))


_MESSAGE = 4  # bytes; the shield ignores all other lengths
_FULL: Final = 10_000  # duty cycle in 1/100 %
_SIGN: Final = {1: -1.0, 2: 1.0}  # counter-clockwise, clockwise; brake, stop and standby do not turn


class MotorShield:
    """The motor shield. ``speeds`` of motors A and B are −1..1, + = clockwise; they persist when the MCU resets.

    The motors are off until the PWM frequency is set. ``before_change`` is called just before a message takes effect.
    """

    def __init__(self) -> None:
        self.before_change: Callable[[], None] = lambda: None
        self.frequency_hz = 0
        self._commanded = [0.0, 0.0]

    @property
    def speeds(self) -> tuple[float, float]:
        return (self._commanded[0], self._commanded[1]) if self.frequency_hz else (0.0, 0.0)

    def write(self, data: bytes) -> None:
        """Take a message: 0x10 or 0x11 (motor A or B), direction, two bytes of duty; or 0, three bytes of frequency."""
        if len(data) != _MESSAGE:
            return
        self.before_change()
        if data[0] & 0xF0 == 0x10:
            duty = min(_FULL, int.from_bytes(data[2:], "big")) / _FULL
            self._commanded[data[0] & 1] = _SIGN.get(data[1], 0.0) * duty
        elif data[0] == 0:
            self.frequency_hz = int.from_bytes(data[1:], "big")

    def read(self, count: int) -> bytes:
        return bytes(count)
