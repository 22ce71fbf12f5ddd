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


def test_stdin_and_stdout(board: Board) -> None:
    sys, select = board.firmware.module("sys"), board.firmware.module("select")
    poll = select.poll()
    poll.register(sys.stdin, select.POLLIN)
    assert list(poll.ipoll(0)) == []
    board.type(b"M 1\r\n")
    assert poll.poll(0) == [(sys.stdin, select.POLLIN)]
    byte = bytearray(1)
    assert (sys.stdin.buffer.readinto(byte), byte) == (1, b"M")
    assert (sys.stdin.buffer.read(2), sys.stdin.read(1), board.unread) == (b" 1", "\n", 1)
    sys.stdout.buffer.write(b"OK\n")
    sys.stdout.buffer.write(b"abcdef", 1, 2)
    sys.stdout.write("ä\n")
    board.print("x", 5)
    assert board.take_output() == "OK\nbcä\r\nx 5\r\n".encode()


def test_reading_more_than_there_is_would_hang(board: Board) -> None:
    sys = board.firmware.module("sys")
    board.type(b"ab")
    with pytest.raises(WouldHang, match="waits for input"):
        sys.stdin.buffer.read(3)
    with pytest.raises(WouldHang):
        board.firmware.module("select").poll().poll()


def test_timers_go_on_while_the_firmware_waits(board: Board, clock: VirtualClock) -> None:
    sys, calls = board.firmware.module("sys"), []
    timer = machine(board).Timer(-1, period=5, callback=lambda _timer: calls.append(clock.now()))
    board.firmware.module("time").sleep_ms(12)
    assert (clock.now(), calls) == (pytest.approx(1000.012), [pytest.approx(1000.005), pytest.approx(1000.010)])
    board.timers.on_wait = lambda: board.type(b"x\ry") if len(calls) == 4 else None
    assert sys.stdin.read(2) == "x\n"
    assert clock.now() == pytest.approx(1000.020)
    timer.deinit()
    board.firmware.module("time").sleep_ms(12)
    assert len(calls) == 4


def test_a_timer_that_fires_once(board: Board) -> None:
    calls: list[object] = []
    kind = machine(board).Timer
    timer = kind()
    timer.init(period=5, mode=kind.ONE_SHOT, callback=calls.append)
    board.firmware.module("time").sleep_ms(12)
    assert calls == [timer]
    with pytest.raises(ValueError, match="period"):
        kind(-1, callback=calls.append)


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
    board.type(b"M\x03X")
    with pytest.raises(KeyboardInterrupt):
        poll.poll(0)
    assert sys.stdin.buffer.read(1) == b"X"
    board.firmware.module("micropython").kbd_intr(-1)
    board.type(b"\x03")
    assert sys.stdin.buffer.read(1) == b"\x03"


def test_a_host_that_does_not_read_costs_half_a_second_per_write(board: Board, clock: VirtualClock) -> None:
    sys, select = board.firmware.module("sys"), board.firmware.module("select")
    poll = select.poll()
    poll.register(sys.stdout, select.POLLOUT)
    board.console.reading = False
    assert sys.stdout.buffer.write(bytes(300)) == 256
    assert (clock.now(), board.console.lost) == (1000.5, 44)
    assert poll.poll(0) == []
    poll.poll(20)
    assert clock.now() == pytest.approx(1000.52)
    assert board.take_output() == bytes(256)
    assert poll.poll(20) == [(sys.stdout, select.POLLOUT)]
    assert clock.now() == pytest.approx(1000.52)
