"""The simulated MCU as a serial port, opened by a plain pyserial program."""

import subprocess
import sys
import time
from pathlib import Path

import pytest
import serial

from pebble.errors import DeviceError
from pebble.extensions.lab.simulation.pty import PtyMcu
from pebble.extensions.lab.simulation.trace import read_trace
from tests.support import WAIT_S, until


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


def test_it_never_takes_a_file_away(tmp_path: Path) -> None:
    notes = tmp_path / "notes.txt"
    notes.write_text("precious")
    with pytest.raises(DeviceError, match=r"notes\.txt: the path exists and is not a symlink"):
        PtyMcu("goob", notes).open()
    assert notes.read_text() == "precious"
