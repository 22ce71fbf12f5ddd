"""The serial port of a simulated board, and what goes on while its firmware waits there."""

from __future__ import annotations

from typing import Any

import pytest

from pebble.extensions.lab.simulation.micropython.board import Board
from pebble.extensions.lab.simulation.micropython.clock import VirtualClock
from pebble.extensions.lab.simulation.micropython.faults import WouldHang
from pebble.extensions.lab.simulation.micropython.timers import BoardReset


def machine(board: Board) -> Any:
    return board.firmware.module("machine")


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


def test_ctrl_c_stops_firmware_that_does_not_forbid_it(board: Board) -> None:
    sys, select = board.firmware.module("sys"), board.firmware.module("select")
    poll = select.poll()
    poll.register(sys.stdin, select.POLLIN)
    board.console.type(b"M\x03X")
    with pytest.raises(KeyboardInterrupt):
        poll.poll(0)
    assert sys.stdin.buffer.read(1) == b"X"
    board.firmware.module("micropython").kbd_intr(-1)
    board.console.type(b"\x03")
    assert sys.stdin.buffer.read(1) == b"\x03"


def test_a_host_that_does_not_read_costs_half_a_second_per_write(board: Board, clock: VirtualClock) -> None:
    sys, select = board.firmware.module("sys"), board.firmware.module("select")
    poll = select.poll()
    poll.register(sys.stdout, select.POLLOUT)
    board.console.reading = False
    assert sys.stdout.buffer.write(bytes(300)) == 256
    assert (clock.now(), board.console.lost) == (1000.5, 44)
    assert poll.poll(0) == []
    assert board.console.take_output() == bytes(256)
    assert poll.poll(0) == [(sys.stdout, select.POLLOUT)]
