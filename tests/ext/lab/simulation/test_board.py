"""The firmware of Goob and Fred on simulated boards, and a body, without a real clock or a pty."""

from itertools import pairwise

import pytest

from pebble.extensions.lab.simulation.board import SimulatedMcu
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
