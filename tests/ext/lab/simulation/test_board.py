"""The firmware of Goob and Fred on simulated boards, and a body, without a real clock or a pty."""

from itertools import pairwise

import pytest

from pebble.extensions.lab.simulation.board import SimulatedMcu
from pebble.extensions.lab.simulation.bodies import body_of
from pebble.extensions.lab.simulation.micropython.board import Board
from pebble.extensions.lab.simulation.micropython.clock import VirtualClock
from pebble.extensions.lab.simulation.motion import FULL_SPEED_MM_S
from pebble.services.serial_mcu_bridge.pebble_serial_v1.frame import END, Type, decode


def test_after_a_pause_there_is_one_report_and_not_all_that_were_missed() -> None:
    mcu = SimulatedMcu("goob", 0.0)
    mcu.tick(0.0)
    assert mcu.tick(3.0).count(b"T a0=") == 1
    assert mcu.tick(3.001) == b""


def test_each_change_of_the_motors_is_reported_with_its_time() -> None:
    changes = []
    mcu = SimulatedMcu("goob", 0.0, on_motors=lambda now, motors: changes.append((now, motors)))
    mcu.receive(b"M 0.5 -0.25\n", 0.1)
    mcu.receive(b"M 0.5 -0.25\n", 0.2)
    mcu.tick(5.0)
    assert changes == [(0.1, (0.5, -0.25)), (pytest.approx(1.2, abs=0.005), (0.0, 0.0))], "+ is ahead on both sides"


def test_an_error_in_the_firmware_stops_the_motors_and_starts_it_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    mcu = SimulatedMcu("goob", 0.0)
    mcu.receive(b"M 1 1\n", 0.0)
    monkeypatch.setattr(mcu.robot.port, "read", lambda: 1 / 0)
    assert mcu.tick(0.1).startswith(b"Starting setup...")
    assert mcu.body.outputs() == (0.0, 0.0)
    assert mcu.resets == 1
    assert b"OK M\r\n" in mcu.receive(b"M 1 1\n", 0.3)
    assert mcu.body.outputs() == (1.0, -1.0)


def test_a_host_that_was_away_for_a_while_misses_no_sample() -> None:
    """A wait of half a second, which is more than the scheduler of a busy machine takes away."""
    mcu = SimulatedMcu("goob_imu", 0.0)
    messages = b"".join(mcu.tick(now) for now in (0.0, 0.1, 0.55, 1.0))
    frames = [decode(stuffed) for stuffed in messages.split(END) if stuffed]
    samples = [frame.timestamp for frame in frames if frame.type == Type.SAMPLE]
    assert [b - a for a, b in pairwise(samples)] == [10] * (len(samples) - 1)
    assert len(samples) >= 98


def test_a_long_turn_reports_each_change_within_it() -> None:
    clock = VirtualClock(50.0)
    body = body_of("minilamp", Board(clock))
    changes: list[tuple[float, tuple[float, float]]] = []
    body.on_motors = lambda now, motors: changes.append((now, motors))
    machine = body.board.firmware.module("machine")
    for ahead, _ in (body.pins.LEFT, body.pins.RIGHT):
        machine.PWM(machine.Pin(ahead), freq=1000, duty_u16=65535)
    clock.advance(2.0)
    body.board.pins.float_all()
    clock.advance(3.0)
    body.end_turn()
    assert changes == [(50.0, (1.0, 1.0)), (52.0, (0.0, 0.0))]
    body.advance()
    assert body.motion.pose.x_mm == pytest.approx(2.0 * FULL_SPEED_MM_S, rel=0.01), "it rolled two seconds, not five"
