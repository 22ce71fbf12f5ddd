"""Odometry in lockstep with Goob's firmware."""

from __future__ import annotations

import math
import random
import re
from collections.abc import Callable
from itertools import count

import pytest

from pebble.contract.payloads import Drive, ImuFast, ImuFastValues, MotorPower, Orientation, TouchValues, Vector
from pebble.extensions.lab.simulation.board import SimulatedMcu
from pebble.extensions.lab.simulation.motion import FULL_SPEED_MM_S, TRACK_MM
from pebble.extensions.scripts.perception.hall import HallSample, HallWheel, SensorRange
from pebble.extensions.scripts.perception.odometry import Directions, Odometry, OdometrySettings

ONE_SENSOR = OdometrySettings(second_channel="none")
FIELDS = """
    x_mm y_mm heading_rad heading_deg left_mm right_mm distance_mm left_crossings right_crossings
    unknown_direction_events left_step_total right_step_total left_mm_per_step right_mm_per_step
    left_extrema_events right_extrema_events left_rejected_sign_flips right_rejected_sign_flips
    left_stall_events right_stall_events sample_seq publish_seq
"""
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
    """Goob's motor board and body; ``odometry`` receives the commands and samples that it would on the robot.

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
        self.motion.left_mm, self.motion.right_mm = start_mm
        self.odometry = Odometry(geometry or OdometrySettings(), self.now)
        self._gyro, self._noise, self._sign = gyro, noise, gyro_sign
        self._random = random.Random(1)
        self._received = b""
        self._sequence = count()

    def drive(self, seconds: float, x: float = 0.0, z: float = 0.0) -> None:
        """Repeat a command for ``seconds``, then go on at once."""
        end = self.now + seconds
        while self.now < end - 1e-9:
            self.command(Drive(x=x, z=z))
            self.wait(min(0.1, end - self.now))

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
            self.now = min(end, self.now + 0.01)
            self._take(self.mcu.tick(self.now))
            if self._gyro:
                turn = math.degrees((self.motion.right_mm_s - self.motion.left_mm_s) / TRACK_MM)
                z = max(-327.0, min(327.0, self._sign * turn + 0.3 + self._random.gauss(0.0, 0.05)))
                self.odometry.imu(turning(z, self.now, next(self._sequence)), self.now)

    def error_mm(self) -> float:
        """How far the pose is from the true one."""
        pose = self.motion.pose
        return math.hypot(self.odometry.pose.x_mm - pose.x_mm, self.odometry.pose.y_mm - pose.y_mm)

    def _take(self, output: bytes) -> None:
        found, self._received = touches(self._received + output, lambda: self._random.gauss(0.0, self._noise))
        for values in found:
            self.odometry.touch(values, self.now)


@pytest.mark.parametrize(("power", "start"), [(0.4, 3), (-1.0, 2)])
@pytest.mark.parametrize("geometry", [None, ONE_SENSOR])
def test_2_m_straight_are_right_within_10_mm(power: float, start: int, geometry: OdometrySettings | None) -> None:
    rig = WheelsRig(geometry=geometry, start_mm=(start * 5.3, start * 3.7))
    rig.wait(0.5)
    rig.drive(2000 / FULL_SPEED_MM_S / abs(power), z=power)
    rig.stop()
    assert abs(rig.odometry.distance_mm - math.hypot(rig.motion.pose.x_mm, rig.motion.pose.y_mm)) < 3
    assert rig.error_mm() < 10


@pytest.mark.parametrize(("side", "gyro"), [(1, False), (-1, True)])
def test_a_square_ends_where_it_began(side: int, gyro: bool) -> None:
    """``side`` 1 turns to the left, −1 to the right; each is 1 m."""
    rig = WheelsRig(gyro=gyro)
    rig.wait(2.0)
    for _ in range(4):
        rig.drive(1000 / FULL_SPEED_MM_S / 0.5, z=0.5)
        rig.stop()
        rig.drive(math.pi / 4 * TRACK_MM / FULL_SPEED_MM_S / 0.3, x=-side * 0.3)
        rig.stop()
    assert rig.error_mm() < 25
    off = rig.odometry.pose.heading_rad - rig.motion.pose.heading_rad
    assert abs(math.remainder(off, math.tau)) < math.radians(1.5)
    assert rig.odometry.value().get("heading_source") == {True: "gyro", False: None}[gyro]


def test_reversals_without_a_stop_lose_no_step() -> None:
    """Twenty random commands, each straight after the other."""
    rig, chosen = WheelsRig(noise=3.0), random.Random(0)
    rig.wait(0.5)
    for _ in range(20):
        rig.drive(chosen.uniform(0.2, 2.0), x=chosen.uniform(-1, 1), z=chosen.uniform(-1, 1))
    rig.stop()
    value = rig.odometry.value()
    assert value["left_mm"] == pytest.approx(rig.motion.left_mm, abs=2), "its second sensor shows the direction"
    assert value["right_mm"] == pytest.approx(rig.motion.right_mm, abs=10)


def test_all_fields_of_the_payload() -> None:
    rig = WheelsRig()
    rig.drive(1.0, z=0.5)
    value = rig.odometry.value()
    assert list(value) == FIELDS.split()
    assert value["left_mm_per_step"] == pytest.approx(math.pi * 61 / 10, abs=1e-5)
    assert value["sample_seq"] == 50
    assert (value["publish_seq"], rig.odometry.value()["publish_seq"]) == (1, 2)
    assert (value["left_stall_events"], value["unknown_direction_events"]) == (0, 0)


def test_moving_ends_and_standing_adds_no_distance_although_the_sensors_are_noisy() -> None:
    rig = WheelsRig(noise=3.0)
    assert not rig.odometry.moving(rig.now)
    rig.drive(2.0, z=0.5)
    assert rig.odometry.moving(rig.now)
    rig.stop(1.0)
    assert not rig.odometry.moving(rig.now)
    before = rig.odometry.distance_mm
    rig.wait(20.0)
    assert rig.odometry.distance_mm == pytest.approx(before, abs=1)


def test_a_push_without_a_command_is_of_unknown_direction() -> None:
    rig = WheelsRig(geometry=ONE_SENSOR)
    rig.drive(2.0, z=0.5)
    rig.stop(2.0)
    before = rig.odometry.value()
    for _ in range(60):
        rig.motion.advance(0.3, 0.3, 0.02)
        rig.wait(0.02)
    value = rig.odometry.value()
    assert value["unknown_direction_events"] > 2
    assert (value["x_mm"], value["left_mm"]) == (before["x_mm"], before["left_mm"])


@pytest.mark.parametrize(("coasted_s", "directions"), [(0.35, (1, -1)), (0.36, (0, 0))])
def test_a_direction_stays_for_as_long_as_wheels_coast(coasted_s: float, directions: tuple[int, int]) -> None:
    power = Directions(0.0)
    assert power.at(0.0) == ((0.0, 0), (0.0, 0))
    power.command(MotorPower(left=0.5, right=-0.02), 0.0)
    assert power.at(0.5) == ((0.5, 1), (-0.02, -1))
    power.command(MotorPower(left=0.0, right=0.01), 1.0)
    assert power.at(1.0 + coasted_s) == ((0.0, directions[0]), (0.01, directions[1]))


def test_an_inertial_sensor_that_lies_otherwise_is_not_believed() -> None:
    rig = WheelsRig(gyro=True, gyro_sign=-1.0)
    rig.wait(1.0)
    rig.drive(6.0, x=-0.3)
    rig.stop()
    assert "heading_source" not in rig.odometry.value()
    rig.drive(4.0, x=0.3)
    assert rig.odometry.moving(rig.now)


# -- one wheel's hall sensor, from samples that are made here


STEP_MM = 10.0


def sample(phase: float, *, power: float = 0.5, amplitude: float = 297.0, second: float | None = None) -> HallSample:
    """``second``: 1 or −1, on which side of the first one the second sensor is."""
    quadrature = None if second is None else round(512 - second * amplitude * math.cos(phase))
    return HallSample(round(512 + amplitude * math.sin(phase)), quadrature, power, (power > 0) - (power < 0))


@pytest.mark.parametrize("second", [None, 1.0, -1.0])
@pytest.mark.parametrize("start", [0.3, 4.0])
def test_the_distance_is_exact_between_steps(second: float | None, start: float) -> None:
    wheel = HallWheel(STEP_MM)
    for number in range(401):
        wheel.update(sample(start + 0.1 * number, second=second))
    assert wheel.mm == pytest.approx(40.0 / math.pi * STEP_MM, abs=0.3)
    assert wheel.steps == pytest.approx(40.0 / math.pi, abs=0.2)
    assert 12 <= wheel.extrema <= 14


def test_a_second_sensor_shows_a_direction_against_the_command() -> None:
    wheel = HallWheel(STEP_MM)
    for number in range(400):
        wheel.update(sample(0.2 * number, second=1.0))
    before = wheel.mm
    for number in range(100):
        wheel.update(sample(0.2 * (399 - number), second=1.0))  # pushed back, while it is commanded to go on
    assert wheel.mm - before == pytest.approx(-19.8 / math.pi * STEP_MM, abs=0.5)


def test_less_than_a_swing_is_no_motion() -> None:
    wheel = HallWheel(STEP_MM)
    for number in range(1000):
        wheel.update(sample(0.3 * number, amplitude=10.0))
    assert (wheel.mm, wheel.steps, wheel.ready) == (0.0, 0.0, True)


def test_the_range_follows_a_signal_that_becomes_smaller() -> None:
    sensor = SensorRange()
    for number in range(20_000):
        sensor.update(512 + (300 if number < 200 else 200) * math.sin(0.3 * number))
    assert (sensor.low, sensor.high) == (pytest.approx(312, abs=8), pytest.approx(712, abs=8))
    assert sensor.level(512) == pytest.approx(0.0, abs=0.02)


def test_a_wheel_that_stands_for_long_forgets_its_rest() -> None:
    wheel = HallWheel(STEP_MM)
    for _ in range(5000):
        wheel.update(sample(0.7, power=0.0))
    for number in range(400):
        wheel.update(sample(0.7 + 0.1 * number))
    assert wheel.mm == pytest.approx(39.9 / math.pi * STEP_MM, abs=0.5)
