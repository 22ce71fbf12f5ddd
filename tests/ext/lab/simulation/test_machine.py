"""Mistakes of firmware that a simulated board notices: it would hang, it starves the watchdog, pins share a signal."""

from __future__ import annotations

from typing import Any

import pytest

from pebble.extensions.lab.simulation.micropython.board import Board
from pebble.extensions.lab.simulation.micropython.clock import VirtualClock
from pebble.extensions.lab.simulation.micropython.faults import SharedPwm, WouldHang
from pebble.extensions.lab.simulation.micropython.timers import BoardReset


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
