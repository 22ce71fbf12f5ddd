"""The machine module of a simulated board: pins, PWM, ADC, I2C and the watchdog."""

from __future__ import annotations

from typing import Any

import pytest

from pebble.extensions.lab.simulation.micropython.board import Board
from pebble.extensions.lab.simulation.micropython.clock import VirtualClock
from pebble.extensions.lab.simulation.micropython.faults import SharedPwm
from pebble.extensions.lab.simulation.micropython.ports import ESP32_C6, ESP8266, SAMD21
from pebble.extensions.lab.simulation.micropython.timers import BoardReset


def machine(board: Board) -> Any:
    return board.firmware.module("machine")


# -- pins


def test_pwm(board: Board) -> None:
    pwm = machine(board).PWM(machine(board).Pin(3), freq=1000, duty_u16=32768)
    assert board.duty(3) == pytest.approx(0.5, abs=1e-4)
    pwm.deinit()
    assert board.duty(3) == 0.0
    pwm.duty_u16(65535)
    assert board.duty(3) == 1.0
    with pytest.raises(ValueError, match="duty_u16"):
        pwm.duty_u16(65536)


@pytest.mark.parametrize(
    ("port", "wrong"), [(ESP32_C6, "D3"), (ESP8266, "D3"), (SAMD21, 3), (SAMD21, "D11"), (SAMD21, "PA30")]
)
def test_pins_have_the_names_of_their_port(clock: VirtualClock, port: Any, wrong: Any) -> None:
    board = Board(clock, port=port)
    with pytest.raises(ValueError, match="not a Pin"):
        machine(board).Pin(wrong)
    with pytest.raises(ValueError, match="not a Pin"):
        board.duty(wrong)


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


# -- watchdog and reset


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
