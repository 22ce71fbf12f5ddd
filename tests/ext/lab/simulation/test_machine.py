"""Mistakes of firmware that a simulated board notices, and the firmware of Goob and Fred on such boards."""

from __future__ import annotations

from typing import Any

import pytest

from pebble.extensions.lab.simulation.board import SimulatedMcu
from pebble.extensions.lab.simulation.micropython.board import Board
from pebble.extensions.lab.simulation.micropython.clock import VirtualClock
from pebble.extensions.lab.simulation.micropython.faults import SharedPwm, WouldHang
from pebble.extensions.lab.simulation.micropython.ports import ESP32_C6
from pebble.extensions.lab.simulation.micropython.timers import BoardReset


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock(1000.0)


@pytest.fixture
def board(clock: VirtualClock) -> Board:
    return Board(clock, port=ESP32_C6)


def machine(board: Board) -> Any:
    return board.firmware.module("machine")


def test_two_pins_on_one_pwm_channel_of_a_xiao_are_a_fault(clock: VirtualClock) -> None:
    board = Board(clock)
    first = machine(board).PWM("D1", freq=1000)
    machine(board).PWM("D10", freq=1000)  # now both timers are in use
    with pytest.raises(SharedPwm, match="PA08 and PA04 are both on channel 0 of TCC0"):
        machine(board).PWM("D4", freq=1000)
    first.deinit()
    machine(board).PWM("D4", freq=1000, duty_u16=65535)
    assert board.duty("D4") == 1.0
    with pytest.raises(SharedPwm):
        first.duty_u16(5)


def test_the_watchdog_counts_and_starves(board: Board, clock: VirtualClock) -> None:
    assert not board.watchdog.starved(clock.now() + 1e9), "it is not armed yet"
    dog = machine(board).WDT(timeout=2000)
    clock.advance(1.9)
    dog.feed()
    assert board.watchdog.feeds == 1
    assert not board.watchdog.starved(clock.now() + 1.99)
    assert board.watchdog.starved(clock.now() + 2.0)
    clock.advance(2.5)
    with pytest.raises(BoardReset):
        dog.feed()


def test_reading_more_than_there_is_would_hang(board: Board) -> None:
    sys = board.firmware.module("sys")
    board.console.type(b"ab")
    with pytest.raises(WouldHang, match="waits for input"):
        sys.stdin.buffer.read(3)
    with pytest.raises(WouldHang):
        board.firmware.module("select").poll().poll(20)


def test_timers_do_not_feed_the_watchdog(board: Board, clock: VirtualClock) -> None:
    machine(board).WDT(timeout=2000)
    machine(board).Timer(-1, period=5, callback=lambda _timer: None)
    with pytest.raises(BoardReset):
        board.firmware.module("sys").stdin.read(1)
    assert clock.now() == pytest.approx(1002.0)


# -- boards with a body


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
