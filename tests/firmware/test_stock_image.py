"""MicroPython's official image for the XIAO SAMD21, without select and sys.stdin.buffer: what is different there."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import pytest

from pebble.extensions.lab.simulation.micropython.modules.machine import Machine
from pebble.extensions.lab.simulation.micropython.ports import SAMD21_OFFICIAL
from pebble.extensions.lab.simulation.micropython.timers import BoardReset
from pebble.services.serial_mcu_bridge.pebble_serial_v1.frame import Type
from tests.firmware.benches import ASK, Bench, of


class SwitchedOff(BaseException):
    """Ends the endless loop of main.py."""


class Endless(Bench):
    """Runs main.py, whose loop a timer turns, and does what ``plan`` has for that time; ``output`` has times."""

    def __init__(self, kind: str = "goob") -> None:
        super().__init__(kind, port=SAMD21_OFFICIAL)
        self.output: list[tuple[float, bytes]] = []
        self.plan: list[tuple[float, Callable[[], object]]] = []
        self._end = 0.0
        self.board.timers.on_wait = self._check

    def type(self, typed: dict[float, bytes]) -> None:
        self.plan += [(at, lambda data=data: self.board.console.type(data)) for at, data in typed.items()]  # type: ignore[misc]

    def run(self, seconds: float, *, main: bool = False) -> None:
        """From switching on, for so long; ``main``: by main.py, with a robot of its own."""
        self._end = seconds
        if main:
            self.board.boot()
            self.board.timers.on_wait = self._check
        firmware = self.board.firmware
        with pytest.raises(SwitchedOff):
            firmware.run(f"{self.kind}/main.py") if main else firmware.module("common.run").run(self._built, {})

    def lines(self, pattern: bytes) -> list[float]:
        """The times of output lines like this."""
        return [when for when, data in self.output for line in data.splitlines() if re.fullmatch(pattern, line)]

    def _built(self, _settings: object) -> Any:
        return self.robot

    def _check(self) -> None:
        now = self.clock.now()
        self.body.end_turn()
        if self.board.console.reading and (output := self.board.console.take_output()):
            self.output.append((now, output))
        for entry in [entry for entry in self.plan if entry[0] <= now]:
            self.plan.remove(entry)
            entry[1]()
        if now >= self._end:
            raise SwitchedOff


@pytest.mark.parametrize("kind", ["goob", "fred"])
def test_it_obeys_answers_and_stops_in_silence(kind: str) -> None:
    bench = Endless(kind)
    bench.type({1.5: b"M 0.5 0.5\n", 2.0: b"M 0.5 0.5\r\nL 0 1 0\nX\n", 2.1: b"M 0 \x03 nothing"})
    bench.run(4.0, main=True)
    (began, _), (ended, off) = bench.motors
    assert began == pytest.approx(1.5, abs=0.02)
    assert off == (0.0, 0.0)
    assert 2.99 <= ended <= 3.03
    assert [len(bench.lines(rb"OK M")), len(bench.lines(rb"OK L")), len(bench.lines(rb"ERR .*"))] == [2, 1, 1]
    assert bench.board.resets == 0


def test_a_host_that_does_not_read_does_not_keep_the_motors_running() -> None:
    bench = Endless()
    bench.board.console.reading = False
    bench.type({1.2 + 0.1 * count: b"M 1 1\n" for count in range(20)})
    bench.run(6.0)
    assert bench.motors[-1][1] == (0.0, 0.0)
    assert bench.motors[-1][0] - 3.1 <= 1.6, "one wait of half a second may come in between"


def test_a_fault_in_a_turn_stops_the_motors_and_resets() -> None:
    """A callback's exception is not propagated."""
    bench = Endless()

    def fail() -> None:
        raise MemoryError

    bench.type({1.5: b"M 1 1\n"})
    bench.plan.append((1.6, lambda: setattr(bench.robot, "step", fail)))
    with pytest.raises(BoardReset):
        bench.run(3.0)
    assert bench.clock.now() == pytest.approx(1.6, abs=0.02)
    assert bench.body.outputs() == (0.0, 0.0)


class SlowUart:
    """A port with a buffer of 64 bytes, which 115,200 baud empty by 11.5 in each turn of a millisecond."""

    def __init__(self, uart: Any) -> None:
        self.any, self.readinto, self.baudrate = uart.any, uart.readinto, uart.baudrate
        self.room, self.sent = 64.0, b""

    def write(self, data: bytes, first: int, count: int) -> int | None:
        taken = min(count, int(self.room))
        self.room -= taken
        self.sent += bytes(data[first : first + taken])
        return taken or None


def test_the_imu_speaks_on_its_two_pins_and_keeps_up_with_its_slow_line() -> None:
    """The buffer of the port takes what 115,200 baud have sent, and nothing beyond."""
    lines: list[SlowUart] = []

    def slow(machine: Machine) -> None:
        kind = machine.UART
        machine.UART = lambda *pins, **more: lines.append(SlowUart(kind(*pins, **more))) or lines[-1]

    bench = Bench("goob_imu", port=SAMD21_OFFICIAL, change=slow)
    (line,) = lines
    assert bench.robot.ctrl_c, "USB is free there, so Ctrl-C may be let in"
    assert line.baudrate == 115200
    bench.board.console.type(ASK)
    for _ in range(3000):
        bench.turn(0.001)
        line.room = min(64.0, line.room + 11.5)
    frames = bench.read(line.sent)
    sequences = [frame.sequence for frame in of(frames, Type.SAMPLE)]
    assert sequences == list(range(1, len(sequences) + 1))
    assert len(sequences) >= 296
    assert len(of(frames, Type.DESCRIBE)) == 1


def test_with_an_image_that_has_both_ctrl_c_stays_out_of_the_imus_usb() -> None:
    """A DESCRIBE_REQ begins with 3: the host would stop the board just by asking."""
    bench = Bench("goob_imu")
    assert ASK[0] == 3
    assert not bench.robot.ctrl_c
    assert bench.board.console.interrupt == -1
