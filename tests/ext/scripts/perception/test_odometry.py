"""Odometry in lockstep with Goob's firmware."""

from __future__ import annotations

import math
import random

import pytest

from pebble.contract.payloads import MotorPower
from pebble.extensions.lab.simulation.motion import FULL_SPEED_MM_S, TRACK_MM
from pebble.extensions.scripts.perception.odometry import Directions, OdometrySettings
from tests.ext.scripts.perception.wheels_rig import WheelsRig
from tests.support import cases, some

ONE_SENSOR = OdometrySettings(second_channel="none")
FIELDS = """
    x_mm y_mm heading_rad heading_deg left_mm right_mm distance_mm left_crossings right_crossings
    unknown_direction_events left_step_total right_step_total left_mm_per_step right_mm_per_step
    left_extrema_events right_extrema_events left_rejected_sign_flips right_rejected_sign_flips
    left_stall_events right_stall_events sample_seq publish_seq
"""


@pytest.mark.parametrize(("power", "start"), some([(0.1, 1), (0.4, 3), (0.7, 5), (1.0, 7), (-1.0, 2)], 2))
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
    assert rig.error_deg() < 1.5
    assert rig.odometry.value().get("heading_source") == {True: "gyro", False: None}[gyro]


@pytest.mark.parametrize("seed", range(cases(1, 3)))
def test_reversals_without_a_stop_lose_no_step(seed: int) -> None:
    """Twenty random commands, each straight after the other."""
    rig, chosen = WheelsRig(noise=3.0, start_mm=(seed * 5.3, seed * 3.7)), random.Random(seed)
    rig.wait(0.5)
    for _ in range(20):
        rig.drive(chosen.uniform(0.2, 2.0), x=chosen.uniform(-1, 1), z=chosen.uniform(-1, 1))
    rig.stop()
    left, right = rig.wheel_errors_mm()
    assert abs(left) < 2, "its second sensor shows the direction"
    assert abs(right) < 10


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


def test_a_wheel_that_is_held_is_a_stall_and_no_distance() -> None:
    rig = WheelsRig()
    rig.drive(2.0, z=0.5)
    rig.stop()
    before = rig.odometry.distance_mm
    rig.mcu.body.forward = lambda _left, _right: (0.0, 0.0)  # type: ignore[method-assign]
    rig.drive(3.0, z=0.5)
    value = rig.odometry.value()
    assert (value["left_stall_events"], value["right_stall_events"]) == (1, 1)
    assert value["distance_mm"] == pytest.approx(before, abs=6)


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


@pytest.mark.parametrize(("coasted_s", "directions"), [(0.0, (1, -1)), (0.35, (1, -1)), (0.36, (0, 0)), (9.0, (0, 0))])
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


def test_steps_are_counted_slowly_too() -> None:
    rig = WheelsRig()
    rig.drive(20.0, z=0.05)
    rig.stop()
    assert rig.error_mm() < 5
    assert rig.odometry.value()["left_crossings"] == round(rig.motion.left_mm // (math.pi * 6.1))
