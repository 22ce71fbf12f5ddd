"""The firmware of Goob and Fred on simulated boards, and a body, without a real clock or a pty."""

import pytest

from pebble.extensions.lab.simulation.board import SimulatedMcu


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
