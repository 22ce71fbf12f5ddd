"""MicroPython's official image for the XIAO SAMD21, without select and sys.stdin.buffer: what is different there.

tests/simulation/test_official_image.py drives whole robots on it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from pebble.services.serial_mcu_bridge.pebble_serial_v1.frame import Frame, Type, decode, encode
from pebble.simulation.bodies import body_of
from pebble.simulation.micropython.board import Board
from pebble.simulation.micropython.clock import VirtualClock
from pebble.simulation.micropython.ports import SAMD21_OFFICIAL
from pebble.simulation.micropython.timers import BoardReset


class SwitchedOff(BaseException):
    """Ends the endless loop."""


class Bench:
    """``at`` seconds something happens; ``run`` switches on until then."""

    def __init__(self, kind: str = "goob") -> None:
        self.clock = VirtualClock()
        self.board = Board(self.clock, port=SAMD21_OFFICIAL)
        self.body = body_of(kind, self.board)
        self.robot: Any = self.board.load(kind, {})
        self.output = b""
        self._plan: list[tuple[float, Callable[[], None]]] = []
        self._end = 0.0
        self.board.timers.on_wait = self._check

    def at(self, seconds: float, act: Callable[[], None]) -> None:
        self._plan.append((seconds, act))

    def run(self, seconds: float) -> None:
        self._end = seconds
        self.board.firmware.module("common.run").run(lambda _settings: self.robot, {})

    def _check(self) -> None:
        now = self.clock.now()
        self.body.end_turn()
        if self.board.console.reading:
            self.output += self.board.take_output()
        for entry in [entry for entry in self._plan if entry[0] <= now]:
            self._plan.remove(entry)
            entry[1]()
        if now >= self._end:
            raise SwitchedOff


def test_it_speaks_again_when_the_host_reads_again() -> None:
    bench = Bench()
    console = bench.board.console
    received: list[int] = []
    bench.at(2.0, lambda: setattr(console, "reading", False))
    bench.at(4.0, lambda: setattr(console, "reading", True))
    bench.at(5.6, lambda: received.append(len(bench.output)))
    with pytest.raises(SwitchedOff):
        bench.run(6.6)
    lines = bench.output[received[0] :].split(b"\r\n")
    assert len([line for line in lines if line.startswith(b"T a0=")]) >= 49
    assert b"\r\r" not in bench.output


def test_a_flood_does_not_keep_the_motors_running() -> None:
    bench = Bench()
    moving = []
    bench.at(1.5, lambda: bench.board.type(b"M 1 1\n" + b"x" * 100_000))
    bench.at(1.6, lambda: moving.append(bench.body.outputs()))
    bench.at(2.6, lambda: moving.append(bench.body.outputs()))
    with pytest.raises(SwitchedOff):
        bench.run(2.7)
    assert bench.board.unread > 0
    assert moving == [(1.0, -1.0), (0.0, 0.0)]


def test_a_fault_in_a_turn_stops_the_motors_and_resets() -> None:
    """A callback's exception is not propagated."""
    bench = Bench()

    def fail() -> None:
        raise MemoryError

    bench.at(1.5, lambda: bench.board.type(b"M 1 1\n"))
    bench.at(1.6, lambda: setattr(bench.robot, "step", fail))
    with pytest.raises(BoardReset):
        bench.run(3.0)
    assert bench.clock.now() == pytest.approx(1.6, abs=0.02)
    assert bench.body.outputs() == (0.0, 0.0)


def test_the_imu_speaks_on_its_two_pins() -> None:
    bench = Bench("goob_imu")
    assert bench.robot.ctrl_c, "USB is free there, so Ctrl-C may be let in"
    assert bench.robot.port._uart.baudrate == 115200
    bench.board.type(encode(Frame(Type.DESCRIBE_REQ)))
    for _ in range(1000):
        bench.clock.advance(0.001)
        bench.robot.step()
    kinds = [frame.type for frame in _frames(bench.board.take_output())]
    assert kinds.count(Type.SAMPLE) == 99
    assert kinds.count(Type.DESCRIBE) == 1


def test_the_imu_keeps_up_with_its_slow_line() -> None:
    """The buffer of the port takes what 115,200 baud have sent, and nothing beyond."""
    bench = Bench("goob_imu")
    line = SlowLine(bench.robot.port._uart)
    bench.robot.port._uart = line
    bench.board.type(encode(Frame(Type.DESCRIBE_REQ)))
    for _ in range(3000):
        bench.clock.advance(0.001)
        line.room = min(64.0, line.room + 11.5)
        bench.robot.step()
    sequences = [frame.sequence for frame in _frames(line.sent) if frame.type is Type.SAMPLE]
    assert sequences == list(range(1, len(sequences) + 1))
    assert len(sequences) >= 296


def _frames(sent: bytes) -> list[Frame]:
    """Whole ones. Empty ones mean nothing: a zero may come first, in case half a frame stands before it."""
    return [decode(raw) for raw in sent.split(b"\0")[:-1] if raw]


class SlowLine:
    def __init__(self, uart: Any) -> None:
        self.any, self.readinto = uart.any, uart.readinto
        self.room = 64.0
        self.sent = b""

    def write(self, data: bytes, first: int, count: int) -> int | None:
        taken = min(count, int(self.room))
        self.room -= taken
        self.sent += bytes(data[first : first + taken])
        return taken or None


def test_with_an_image_that_has_both_ctrl_c_stays_out_of_the_imus_usb() -> None:
    """A DESCRIBE_REQ begins with 3: the host would stop the board just by asking."""
    board = Board(VirtualClock())
    body_of("goob_imu", board)
    robot: Any = board.load("goob_imu", {})
    assert encode(Frame(Type.DESCRIBE_REQ))[0] == 3
    assert not robot.ctrl_c
    assert board.console.interrupt == -1
