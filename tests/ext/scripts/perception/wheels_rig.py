"""Goob's motor board, its body and the odometry on one virtual clock."""

from __future__ import annotations

import math
import random
import re
from collections.abc import Callable, Iterator
from itertools import count

from pebble.contract.payloads import Drive, ImuFast, ImuFastValues, MotorPower, Orientation, TouchValues, Vector
from pebble.extensions.lab.simulation.board import SimulatedMcu
from pebble.extensions.lab.simulation.motion import TRACK_MM
from pebble.extensions.scripts.perception.odometry import Odometry, OdometrySettings

TICK_S = 0.01
REPEAT_S = 0.1  # of a drive command
_touch = re.compile(rb"T a0=(\d+) a1=(\d+) a2=(\d+)").fullmatch


def powers(drive: Drive) -> MotorPower:
    left, right = (max(-1.0, min(1.0, power)) for power in (drive.z + drive.x, drive.z - drive.x))
    return MotorPower(left=left, right=right)


def touches(output: bytes, noise: Callable[[], float]) -> tuple[list[TouchValues], bytes]:
    """The hall sensors in what a board has sent, and what is left of it."""
    *lines, rest = output.split(b"\n")
    found = filter(None, map(_touch, (line.strip() for line in lines)))
    values = [[int(value) + round(noise()) for value in one.groups()] for one in found]
    return [TouchValues(a0=a0, a1=a1, a2=a2) for a0, a1, a2 in values], rest


def turning(dps: float, now: float, seq: int = 0) -> ImuFast:
    values = ImuFastValues(
        accel_mps2=Vector(x=0, y=0, z=9.81),
        gyro_dps=Vector(x=0, y=0, z=dps),
        temp_c=30.0,
        orientation_deg=Orientation(roll=0, pitch=0),
    )
    return ImuFast(t=0, seq=seq, mcu_ms=round(now * 1000), value=values)


class WheelsRig:
    """Drive it; ``odometry`` receives the commands and samples that it would on the robot.

    ``noise`` is in counts of the ADC, rms. With ``gyro``, an inertial sensor with noise and a bias of 0.3 degrees/s.
    """

    def __init__(
        self,
        *,
        gyro: bool = False,
        noise: float = 0.0,
        geometry: OdometrySettings | None = None,
        start_mm: tuple[float, float] = (0.0, 0.0),
        gyro_sign: float = 1.0,
    ) -> None:
        self.now = 100.0
        self.mcu = SimulatedMcu("goob", self.now)
        self.motion = self.mcu.motion
        self.start_mm = self.motion.left_mm, self.motion.right_mm = start_mm
        self.odometry = Odometry(geometry or OdometrySettings(), self.now)
        self._gyro, self._noise, self._sign = gyro, noise, gyro_sign
        self._random = random.Random(1)
        self._received = b""
        self._sequence: Iterator[int] = count()

    def drive(self, seconds: float, x: float = 0.0, z: float = 0.0) -> None:
        """Repeat a command for ``seconds``, then go on at once."""
        end = self.now + seconds
        while self.now < end - 1e-9:
            self.command(Drive(x=x, z=z))
            self.wait(min(REPEAT_S, end - self.now))

    def stop(self, seconds: float = 0.6) -> None:
        """Stop, and wait until the wheels stand."""
        self.command(Drive())
        self.wait(seconds)

    def command(self, drive: Drive) -> None:
        power = powers(drive)
        self.odometry.power(power, self.now)
        self._take(self.mcu.receive(b"M %.3f %.3f\n" % (power.left, power.right), self.now))

    def wait(self, seconds: float) -> None:
        end = self.now + seconds
        while self.now < end - 1e-9:
            self.now = min(end, self.now + TICK_S)
            self._take(self.mcu.tick(self.now))
            if self._gyro:
                self.odometry.imu(self._imu(), self.now)

    def error_mm(self) -> float:
        """How far the pose is from the true one."""
        pose = self.motion.pose
        return math.hypot(self.odometry.pose.x_mm - pose.x_mm, self.odometry.pose.y_mm - pose.y_mm)

    def error_deg(self) -> float:
        off = self.odometry.pose.heading_rad - self.motion.pose.heading_rad
        return math.degrees(abs(math.remainder(off, math.tau)))

    def wheel_errors_mm(self) -> tuple[float, float]:
        value, (left, right) = self.odometry.value(), self.start_mm
        return value["left_mm"] - self.motion.left_mm + left, value["right_mm"] - self.motion.right_mm + right

    def _take(self, output: bytes) -> None:
        found, self._received = touches(self._received + output, lambda: self._random.gauss(0.0, self._noise))
        for values in found:
            self.odometry.touch(values, self.now)

    def _imu(self) -> ImuFast:
        turn = math.degrees((self.motion.right_mm_s - self.motion.left_mm_s) / TRACK_MM)
        z = max(-327.0, min(327.0, self._sign * turn + 0.3 + self._random.gauss(0.0, 0.05)))
        return turning(z, self.now, next(self._sequence))
