"""Simulated bodies, from pins to wheels, batteries, lights and I2C devices."""

from __future__ import annotations

import pytest

from pebble.extensions.lab.simulation.bodies import Benjr, Body, body_of
from pebble.extensions.lab.simulation.micropython.board import Board
from pebble.extensions.lab.simulation.micropython.clock import VirtualClock
from pebble.extensions.lab.simulation.motion import FULL_SPEED_MM_S


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock(50.0)


def put(body: Body, pin: str | int, level: float) -> None:
    """Put out a PWM level as firmware does."""
    machine = body.board.firmware.module("machine")
    machine.PWM(machine.Pin(pin), freq=1000, duty_u16=round(level * 65535))


def drive(body: Body, left: float, right: float) -> None:
    """Half bridges: one input driven, the other low."""
    for (ahead, back), speed in zip((body.pins.LEFT, body.pins.RIGHT), (left, right), strict=True):
        put(body, back if speed < 0 else ahead, abs(speed))


@pytest.mark.parametrize(("kind", "forward"), [("minilamp", (1.0, 0.5)), ("fred", (1.0, 0.5)), ("goob", (1.0, -0.5))])
def test_half_bridges_turn_the_wheels(clock: VirtualClock, kind: str, forward: tuple[float, float]) -> None:
    body = body_of(kind, Board(clock))
    drive(body, *forward)
    clock.advance(1.0)
    body.advance()
    assert body.outputs() == pytest.approx(forward, abs=1e-3)
    assert body.forward(*body.outputs()) == pytest.approx((1.0, 0.5), abs=1e-3)
    speeds = body.motion.left_mm_s, body.motion.right_mm_s
    assert speeds == pytest.approx((FULL_SPEED_MM_S, FULL_SPEED_MM_S / 2), rel=0.01)
    assert body.motion.pose.x_mm > 100


def test_a_long_turn_reports_each_change_within_it(clock: VirtualClock) -> None:
    body = body_of("minilamp", Board(clock))
    changes: list[tuple[float, tuple[float, float]]] = []
    body.on_motors = lambda now, motors: changes.append((now, motors))
    drive(body, 1.0, 1.0)
    clock.advance(2.0)
    body.board.pins.float_all()
    clock.advance(3.0)
    body.end_turn()
    assert changes == [(50.0, (1.0, 1.0)), (52.0, (0.0, 0.0))]
    body.advance()
    assert body.motion.pose.x_mm == pytest.approx(2.0 * FULL_SPEED_MM_S, rel=0.01), "it rolled two seconds, not five"


def test_benjrs_shield(clock: VirtualClock) -> None:
    body = body_of("benjr", Board(clock))
    assert isinstance(body, Benjr)
    i2c = body.board.firmware.module("machine").SoftI2C(scl=body.pins.SCL, sda=body.pins.SDA)
    i2c.writeto(body.pins.MOTOR_SHIELD, b"\x10\x02\x13\x88")
    assert body.outputs() == (0.0, 0.0), "nothing turns before the frequency is set"
    i2c.writeto(body.pins.MOTOR_SHIELD, b"\x00\x00\x03\xe8")
    assert body.outputs() == (0.5, 0.0), "clockwise"
    i2c.writeto(body.pins.MOTOR_SHIELD, b"\x11\x01\xff\xff")
    assert body.outputs() == (0.5, -1.0), "counter-clockwise, and not more than full"
    assert body.forward(*body.outputs()) == (-0.5, 1.0), "both motors are mounted backwards"
    for direction in (b"\x00", b"\x03", b"\x04"):
        i2c.writeto(body.pins.MOTOR_SHIELD, b"\x10" + direction + b"\x27\x10")
        assert body.outputs() == (0.0, -1.0)
    i2c.writeto(body.pins.MOTOR_SHIELD, b"\x10\x02\x27")
    assert body.outputs() == (0.0, -1.0), "three bytes are no message"
