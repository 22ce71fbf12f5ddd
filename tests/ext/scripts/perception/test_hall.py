"""One wheel's hall sensor, from samples that are made here."""

from __future__ import annotations

import math

import pytest

from pebble.extensions.scripts.perception.hall import HallSample, HallWheel, SensorRange

STEP_MM = 10.0


def sample(phase: float, *, power: float = 0.5, amplitude: float = 297.0, second: float | None = None) -> HallSample:
    """``second``: 1 or −1, on which side of the first one the second sensor is."""
    quadrature = None if second is None else round(512 - second * amplitude * math.cos(phase))
    return HallSample(round(512 + amplitude * math.sin(phase)), quadrature, power, (power > 0) - (power < 0))


@pytest.mark.parametrize("second", [None, 1.0, -1.0])
@pytest.mark.parametrize("start", [0.3, 1.9, 4.0])
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


def test_a_second_sensor_that_shows_nothing_is_not_used() -> None:
    wheel = HallWheel(STEP_MM)
    for number in range(400):
        wheel.update(sample(0.2 * number)._replace(quadrature=500 + number % 2))
    assert wheel.mm == pytest.approx(79.8 / math.pi * STEP_MM, abs=0.5)


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
