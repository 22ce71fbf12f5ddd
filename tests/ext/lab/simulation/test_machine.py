"""Mistakes of firmware that a simulated board notices, the firmware of Goob and Fred on it, and its serial port."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import serial

from pebble.errors import DeviceError
from pebble.extensions.lab.simulation.board import SimulatedMcu
from pebble.extensions.lab.simulation.micropython.board import Board
from pebble.extensions.lab.simulation.micropython.clock import VirtualClock
from pebble.extensions.lab.simulation.micropython.faults import SharedPwm, WouldHang
from pebble.extensions.lab.simulation.micropython.files import Files
from pebble.extensions.lab.simulation.micropython.ports import ESP32_C6
from pebble.extensions.lab.simulation.micropython.timers import BoardReset
from pebble.extensions.lab.simulation.pty import PtyMcu
from pebble.extensions.lab.simulation.trace import read_trace
from tests.support import WAIT_S, until


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
    board.boot()
    assert not board.watchdog.starved(clock.now() + 1e9)


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


# -- as a serial port


def test_a_host_talks_to_it_and_everything_is_traced_in_time(tmp_path: Path) -> None:
    with PtyMcu("goob", tmp_path / "port", trace=tmp_path / "trace", trace_output=True) as mcu:
        before = time.monotonic_ns()
        with serial.Serial(str(mcu.symlink), 460800, timeout=WAIT_S) as port:
            port.write(b"M 0.5 0.25\nL 1 ")
            assert until(lambda: "M 0.5 0.25" in mcu.trace.lines())
            port.write(b"0 0\r\n")
            assert until(lambda: "L 1 0 0" in mcu.trace.lines())
            assert b"OK M\r\n" in {port.readline() for _ in range(20)}
            assert until(lambda: any(entry.line == "OK M" for entry in mcu.trace.entries()))
        assert until(lambda: not mcu.host)
        after = time.monotonic_ns()
        entries = mcu.trace.entries()
    assert all(before <= entry.ns <= after for entry in entries[1:])
    moved = [entry for entry in entries if entry.event == "motors"]
    assert moved[0].motors == (0.5, 0.25)
    others = [entry for entry in entries if entry.event not in ("motors", "late", "said")]
    assert [entry.event for entry in others] == ["plugged", "opened", "line", "line", "closed"]
    assert others[2].drive == (0.5, 0.25)
    assert others[2].motors is None
    assert others[3].drive is None
    assert read_trace(tmp_path / "trace") == [*entries, mcu.trace.entries()[-1]]


def test_a_host_that_does_not_read_loses_reports_and_stops_nothing(tmp_path: Path) -> None:
    with PtyMcu("goob", tmp_path / "port") as mcu, serial.Serial(str(mcu.symlink), 460800) as port:
        assert until(lambda: mcu.host)
        dropped = mcu.dropped
        while mcu.dropped == dropped:
            port.write(b"X\n" * 50)
            time.sleep(0.001)
        port.write(b"M 0.1 0.1\n")
        assert until(lambda: any(entry.motors == (0.1, 0.1) for entry in mcu.trace.entries()))


def test_the_program(tmp_path: Path) -> None:
    symlink, trace = tmp_path / "port", tmp_path / "trace"
    command = [sys.executable, "-m", "pebble.cli", "sim", "fred", "--link", str(symlink)]
    command += ["--trace", str(trace), "--control"]

    def events() -> list[str]:
        return [entry.event for entry in read_trace(trace)]

    with subprocess.Popen(command, stdin=subprocess.PIPE, text=True, bufsize=1) as program:
        assert program.stdin is not None
        assert until(symlink.exists)
        with serial.Serial(str(symlink), 115200, timeout=WAIT_S) as port:
            port.write(b"M 1 1\n")
            assert until(lambda: (0.93, 1.0) in {entry.motors for entry in read_trace(trace)})
            program.stdin.write("charge\nnonsense\n")
            assert until(lambda: b"chg=1" in port.readline())
            program.stdin.write("unplug\n")
            assert until(lambda: "unplugged" in events())
        program.stdin.write("replug\n")
        assert until(lambda: events().count("plugged") == 2)
        program.stdin.close()
        assert program.wait(WAIT_S) == 0
    assert [entry.line for entry in read_trace(trace) if entry.event == "line"] == ["M 1 1"]
    assert not symlink.is_symlink()


def test_a_trace_or_a_folder_of_files_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match=r"gone/trace: No such file or directory"):
        PtyMcu("goob", tmp_path / "port", trace=tmp_path / "gone" / "trace")
    (tmp_path / "notes").touch()
    with pytest.raises(DeviceError, match=r"notes: File exists"):
        Files(tmp_path / "notes")


def test_it_never_takes_a_file_away(tmp_path: Path) -> None:
    notes = tmp_path / "notes.txt"
    notes.write_text("precious")
    with pytest.raises(DeviceError, match=r"notes\.txt: the path exists and is not a symlink"):
        PtyMcu("goob", notes).open()
    assert notes.read_text() == "precious"
