"""Lists and checks this machine's serial ports, and interrupts the program that runs on a board."""

import os
import stat
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import serial
from serial.tools import list_ports

from pebble.errors import DeviceError

_CTRL_C = b"\x03"
_PROMPT = b">>> "
_AUTOMATIC_S = 3.0  # then the user is asked to press reset
_RESET_PULSE_S = 0.1


def described() -> list[str]:
    """Return a line per serial port: its path, the USB device's own name, and its ids.

    A port that has neither a USB device nor a name is left out.
    """
    lines = []
    for port in sorted(list_ports.comports()):
        name = " ".join(filter(None, (port.manufacturer, port.product))) or port.description
        ids = f" [{port.vid:04x}:{port.pid:04x}]" if port.vid is not None and port.pid is not None else ""
        if port.vid is not None or name not in ("n/a", ""):
            lines.append(f"{port.device}  {name}{ids}")
    return lines


def hint() -> str:
    """Return the list of ports for an error message."""
    ports = described()
    if not ports:
        return "no board is plugged in (some USB cables carry power only: try another)"
    return "available ports:\n" + "\n".join(f"  {line}" for line in ports)


def check(port: str) -> None:
    """Raise DeviceError, with the available ports, unless ``port`` can be opened."""
    path = Path(port)
    try:
        status = path.stat()
    except OSError as error:
        why = "does not exist" if isinstance(error, FileNotFoundError) else f"cannot be used: {error.strerror}"
        raise DeviceError(f"--port {port}: {why}; {hint()}") from None
    if not stat.S_ISCHR(status.st_mode):
        raise DeviceError(f"--port {port}: is not a serial port; {hint()}")
    if not os.access(path, os.R_OK | os.W_OK):
        raise DeviceError(f"--port {port}: permission denied: sudo usermod -aG dialout $USER, then log in again")


def wait_for(port: str, timeout_s: float) -> None:
    """Wait until the port exists: a board with its own USB disappears during a reset. Raises DeviceError on timeout."""
    end = time.monotonic() + timeout_s
    while not os.access(port, os.R_OK | os.W_OK):
        if time.monotonic() > end:
            raise DeviceError(f"--port {port}: did not reappear within {timeout_s:g} s; {hint()}")
        time.sleep(0.1)


def break_in(port: str, ask: Callable[[str], None], *, pulse: bool, timeout_s: float = 60.0) -> None:
    """Stop the program on the board, so that MicroPython's prompt answers.

    Our firmware accepts Ctrl-C only in the first second after a reset: later, no byte on the line may stop it, and its
    watchdog would reset the board during the copy. So the board is reset: by the line's RTS if that is wired
    (``pulse``), else by the user, whom ``ask`` prompts. Raises DeviceError if no prompt appears.
    """
    begin, asked = time.monotonic(), False
    if pulse:
        _reset(port)
    while time.monotonic() < begin + timeout_s:
        with suppress(OSError, serial.SerialException):  # the port may disappear at any time during the reset
            if _answers(port, until=begin + (timeout_s if asked else _AUTOMATIC_S)):
                return
        if not asked and time.monotonic() > begin + _AUTOMATIC_S:
            asked = True
            ask("the board does not answer: press its reset button once, or unplug it and plug it in again")
        time.sleep(0.05)
    raise DeviceError(
        f"--port {port}: MicroPython does not answer; if it is not installed, install it with --micropython FILE"
    )


def _reset(port: str) -> None:
    """Reset the board by RTS, which is wired to EN. DTR stays off: the program starts, not the boot loader."""
    with suppress(OSError, serial.SerialException), serial.Serial(port, 115200) as line:
        line.dtr = False
        line.rts = True
        time.sleep(_RESET_PULSE_S)
        line.rts = False


def _answers(port: str, *, until: float) -> bool:
    """True if MicroPython's prompt comes in time, after Ctrl-C was sent again and again."""
    with serial.Serial(port, 115200, timeout=0.1, write_timeout=0.5) as line:
        received = b""
        while time.monotonic() < until:
            line.write(b"\r" + _CTRL_C)
            received = (received + line.read(256))[-64:]
            if received.endswith(_PROMPT):
                return True
    return False
