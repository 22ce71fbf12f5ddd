"""The simulated IMU: its registers, and what it feels."""

from __future__ import annotations

import math
import statistics
import struct

import pytest

from pebble.extensions.lab.simulation.i2c_devices import Mpu6050
from pebble.extensions.lab.simulation.micropython.clock import VirtualClock
from pebble.extensions.lab.simulation.motion import FULL_SPEED_MM_S, TRACK_MM, RobotMotion


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock(9.0)


def awake(clock: VirtualClock, motion: RobotMotion | None = None) -> Mpu6050:
    imu = Mpu6050(clock.now, motion)
    imu.write(b"\x6b\x01")
    return imu


def mean(imu: Mpu6050, clock: VirtualClock, count: int = 200) -> list[float]:
    """The means of the seven words at the smallest ranges, in g, degrees Celsius and degrees per second."""
    rows = []
    for _ in range(count):
        clock.advance(0.01)
        rows.append(words(imu))
    return [statistics.fmean(column) for column in zip(*rows, strict=True)]


def words(imu: Mpu6050) -> list[float]:
    imu.write(b"\x3b")
    ax, ay, az, temperature, gx, gy, gz = struct.unpack(">7h", imu.read(14))
    return [ax / 16384, ay / 16384, az / 16384, temperature / 340 + 36.53, gx / 131, gy / 131, gz / 131]


def test_at_rest_it_feels_gravity_and_its_bias(clock: VirtualClock) -> None:
    imu = awake(clock)
    ax, ay, az, _, gx, gy, gz = mean(imu, clock)
    assert (ax, ay, az) == pytest.approx((0.0, 0.0, 1.0), abs=0.002)
    assert (gx, gy, gz) == pytest.approx(imu.bias_dps, abs=0.02)


def test_it_goes_along_with_its_robot(clock: VirtualClock) -> None:
    motion = RobotMotion()
    imu = awake(clock, motion)
    turning, leaning, ahead = [], [], []
    for _ in range(100):
        motion.advance(0.5, 1.0, 0.01)
        clock.advance(0.01)
        ax, ay, _, _, _, _, gz = words(imu)
        turning.append(gz - imu.bias_dps[2])
        leaning.append(ay)
        ahead.append(ax)
    turn_rad_s = 0.5 * FULL_SPEED_MM_S / TRACK_MM
    assert statistics.fmean(turning[50:]) == pytest.approx(math.degrees(turn_rad_s), rel=0.01)
    assert statistics.fmean(leaning[50:]) == pytest.approx(0.75 * FULL_SPEED_MM_S * turn_rad_s / 9806.65, rel=0.05)
    gained_mm_s = sum(ahead) * 9806.65 * 0.01
    assert gained_mm_s == pytest.approx(0.75 * FULL_SPEED_MM_S, rel=0.05)
    assert max(ahead[:5]) > 0.1 > statistics.fmean(ahead[50:])
