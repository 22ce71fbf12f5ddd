"""The machine module of a simulated board: pins, PWM, ADC, I2C and the watchdog."""

from __future__ import annotations

import errno
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


def test_an_output(board: Board) -> None:
    pin = machine(board).Pin(3, machine(board).Pin.OUT, value=1)
    assert board.duty(3) == 1.0
    pin.off()
    assert (board.duty(3), pin.value(), pin()) == (0.0, 0, 0)
    pin(1)
    assert (board.duty(3), pin.value()) == (1.0, 1)


def test_an_input_reads_its_pull_resistor_until_it_is_driven(board: Board) -> None:
    kind = machine(board).Pin
    assert kind(3, kind.IN).value() == 0
    pin = kind(3, kind.IN, kind.PULL_UP)
    assert pin.value() == 1
    board.set_pin(3, False)
    assert pin.value() == 0
    board.set_pin(3, lambda: True)
    assert pin.value() == 1
    board.set_pin(3, None)
    assert pin.value() == 1
    pin.on()
    assert board.duty(3) == 0.0, "an input puts out nothing"


def test_pwm(board: Board) -> None:
    pwm = machine(board).PWM(machine(board).Pin(3))
    pwm.duty_u16(32768)
    assert board.duty(3) == 0.0, "without a frequency there is no signal"
    pwm.freq(1000)
    assert board.duty(3) == pytest.approx(0.5, abs=1e-4)
    assert (pwm.freq(), pwm.duty_u16(), pwm.duty()) == (1000, 32768, 512)
    pwm.duty(1023)
    assert board.duty(3) == 1.0
    pwm.deinit()
    assert board.duty(3) == 0.0
    pwm.init(freq=50, duty_u16=65535)
    assert board.duty(3) == 1.0
    with pytest.raises(ValueError, match="duty_u16"):
        pwm.duty_u16(65536)
    with pytest.raises(ValueError, match="freq"):
        pwm.freq(0)


@pytest.mark.parametrize(
    ("port", "wrong"), [(ESP32_C6, "D3"), (ESP8266, "D3"), (SAMD21, 3), (SAMD21, "D11"), (SAMD21, "PA30")]
)
def test_pins_have_the_names_of_their_port(clock: VirtualClock, port: Any, wrong: Any) -> None:
    board = Board(clock, port=port)
    with pytest.raises(ValueError, match="not a Pin"):
        machine(board).Pin(wrong)
    with pytest.raises(ValueError, match="not a Pin"):
        board.duty(wrong)


@pytest.mark.parametrize("name", ["D0", "D6", "D7"])
def test_not_every_pin_of_a_xiao_has_pwm(clock: VirtualClock, name: str) -> None:
    with pytest.raises(ValueError, match="not a PWM Pin"):
        machine(Board(clock)).PWM(name, freq=1000)


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


def test_the_order_of_the_signals_decides_which_timer_a_pin_gets(clock: VirtualClock) -> None:
    board = Board(clock)
    for name in ("D10", "D2", "D8", "D1", "D9"):  # D2 gets TCC0, because only TCC1 is in use yet
        machine(board).PWM(name, freq=1000)
    other = Board(clock)
    for name in ("D10", "D1"):
        machine(other).PWM(name, freq=1000)
    with pytest.raises(SharedPwm, match="TCC1"):
        machine(other).PWM("D2", freq=1000)


@pytest.mark.parametrize(
    ("port", "pin", "full_v", "steps"), [(ESP32_C6, 0, 3.3, 4095), (ESP8266, 0, 1.0, 1023), (SAMD21, "A0", 1.65, 4095)]
)
def test_adc(clock: VirtualClock, port: Any, pin: Any, full_v: float, steps: int) -> None:
    board = Board(clock, port=port)
    adc = machine(board).ADC(pin)
    assert adc.read_u16() == 0
    board.set_volts(pin, full_v / 2)
    assert adc.read_u16() == pytest.approx(32768, abs=1)
    assert adc.read_uv() == pytest.approx(full_v / 2 * 1e6, rel=1e-4)
    board.set_volts(pin, lambda: 5.0)
    assert (adc.read_u16(), adc.read()) == (65535, steps)


# -- I2C


class Memory:
    """A device with 16 registers."""

    def __init__(self) -> None:
        self.registers, self.at = bytearray(16), 0

    def write(self, data: bytes) -> None:
        self.at = data[0]
        self.registers[self.at : self.at + len(data) - 1] = data[1:]

    def read(self, count: int) -> bytes:
        return bytes(self.registers[self.at : self.at + count])


@pytest.mark.parametrize("kind", ["I2C", "SoftI2C"])
def test_i2c(board: Board, kind: str) -> None:
    board.attach_i2c(0x68, Memory())
    i2c = getattr(machine(board), kind)(scl=machine(board).Pin(1), sda=machine(board).Pin(2), freq=400_000)
    i2c.writeto_mem(0x68, 3, b"\x01\x02")
    assert i2c.writeto(0x68, b"\x05\x07") == 2
    buffer = bytearray(3)
    i2c.readfrom_mem_into(0x68, 3, buffer)
    assert (buffer, i2c.readfrom_mem(0x68, 4, 2)) == (b"\x01\x02\x07", b"\x02\x07")
    i2c.writeto(0x68, b"\x03")
    assert i2c.readfrom(0x68, 1) == b"\x01"
    assert i2c.scan() == [0x68]


def test_a_device_may_be_absent_or_fail(board: Board) -> None:
    i2c = machine(board).SoftI2C(scl=1, sda=2)
    board.attach_i2c(0x68, Memory())

    def code() -> int | None:
        try:
            i2c.writeto(0x68, b"\x00")
        except OSError as error:
            return error.errno
        return None

    assert code() is None
    board.bus.fail(0x68)
    assert (code(), i2c.scan()) == (errno.EIO, [])
    board.bus.fail(0x68, errno.ETIMEDOUT)
    assert code() == errno.ETIMEDOUT
    board.bus.restore(0x68)
    assert code() is None
    board.bus.disturbed = True
    assert (code(), i2c.scan()) == (errno.EIO, [])
    board.bus.disturbed = False
    board.bus.detach(0x68)
    assert code() == errno.ENODEV


# -- watchdog and reset


def test_the_watchdog_counts_and_starves(board: Board, clock: VirtualClock) -> None:
    assert not board.starved(clock.now() + 1e9), "it is not armed yet"
    dog = machine(board).WDT(timeout=2000)
    clock.advance(1.9)
    dog.feed()
    assert board.watchdog.feeds == 1
    assert not board.starved(clock.now() + 1.99)
    assert board.starved(clock.now() + 2.0)
    clock.advance(2.5)
    with pytest.raises(BoardReset):
        dog.feed()


@pytest.mark.parametrize(
    ("port", "asked", "real"),
    [(SAMD21, 2000, 1024), (SAMD21, 5, 512), (SAMD21, 99999, 16384), (ESP32_C6, 2000, 2000), (ESP8266, 5000, 5000)],
)
def test_the_timeout_is_what_the_port_makes_of_it(clock: VirtualClock, port: Any, asked: int, real: int) -> None:
    board = Board(clock, port=port)
    machine(board).WDT(timeout=asked)
    assert board.watchdog.timeout_ms == real
