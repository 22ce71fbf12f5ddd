"""The serial ports of this machine, for people who have to choose one, and breaking into a running board."""

from __future__ import annotations

import os
import stat
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import serial
from serial.tools import list_ports

from pebble.errors import LinkError

_CTRL_C = b"\x03"
_PROMPT = b">>> "
_PATIENCE_S = 3.0  # then the user is asked to press reset
_RESET_PULSE_S = 0.1


def described() -> list[str]:
    """One line per serial port, as its USB device calls itself."""
    lines = []
    for port in sorted(list_ports.comports()):
        name = " ".join(filter(None, (port.manufacturer, port.product))) or port.description
        ids = f" [{port.vid:04x}:{port.pid:04x}]" if port.vid is not None and port.pid is not None else ""
        if port.vid is not None or name not in ("n/a", ""):
            lines.append(f"{port.device}  {name}{ids}")
    return lines


def hint() -> str:
    """What to say when the port is not there."""
    found = described()
    if not found:
        return "no board is plugged in (some USB cables only charge: try another)"
    return "there is:\n" + "\n".join(f"  {line}" for line in found)


def check(port: str) -> None:
    """Raise LinkError, with the ports that are there, unless ``port`` can be opened."""
    path = Path(port)
    try:
        found = path.stat()
    except OSError:
        raise LinkError(f"--port {port}: is not there; {hint()}") from None
    if not stat.S_ISCHR(found.st_mode):
        raise LinkError(f"--port {port}: is no serial port; {hint()}")
    if not os.access(path, os.R_OK | os.W_OK):
        raise LinkError(f"--port {port}: may not be used by you: sudo usermod -aG dialout $USER, then log in again")


def wait_for(port: str, timeout_s: float) -> None:
    """Until the port is there: a board with USB of its own vanishes while it resets."""
    end = time.monotonic() + timeout_s
    while not os.access(port, os.R_OK | os.W_OK):
        if time.monotonic() > end:
            raise LinkError(f"--port {port}: has not come back after {timeout_s:g} s; {hint()}")
        time.sleep(0.1)


def break_in(port: str, ask: Callable[[str], None], *, pulse: bool, timeout_s: float = 60.0) -> None:
    """Stop whatever runs on the board, so that MicroPython's prompt answers.

    Our firmware hears Ctrl-C only in its first moments: later it must not be stopped by a byte on the line, and its
    watchdog would reset the board in the middle of a copy. So the board is reset, by the line's RTS where it is wired
    (``pulse``), else by the user. Raises LinkError when nothing answers.
    """
    begin, asked = time.monotonic(), False
    if pulse:
        _reset(port)
    while time.monotonic() < begin + timeout_s:
        with suppress(OSError, serial.SerialException):  # it may vanish at any moment: it is being reset
            if _answers(port, until=begin + (timeout_s if asked else _PATIENCE_S)):
                return
        if not asked and time.monotonic() > begin + _PATIENCE_S:
            asked = True
            ask("it does not answer: press its reset button once, or unplug it and plug it in again")
        time.sleep(0.05)
    raise LinkError(
        f"--port {port}: MicroPython does not answer; if there is none on this board, give its file with --micropython"
    )


def _reset(port: str) -> None:
    """By RTS, wired to EN. DTR stays off, so that the program starts and not the boot loader."""
    with suppress(OSError, serial.SerialException), serial.Serial(port, 115200) as line:
        line.dtr = False
        line.rts = True
        time.sleep(_RESET_PULSE_S)
        line.rts = False


def _answers(port: str, *, until: float) -> bool:
    with serial.Serial(port, 115200, timeout=0.1, write_timeout=0.5) as line:
        heard = b""
        while time.monotonic() < until:
            line.write(b"\r" + _CTRL_C)
            heard = (heard + line.read(256))[-64:]
            if heard.endswith(_PROMPT):
                return True
    return False
