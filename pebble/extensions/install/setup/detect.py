"""Finds the devices of this machine: boards, to which it sends nothing, cameras, and parts that a robot lacks."""

import re
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import serial

from pebble.check_result import State
from pebble.extensions.checks.machine import clock, synchronised
from pebble.extensions.checks.program import run
from pebble.extensions.fleet.folder import PLAIN_PORT, PORT
from pebble.extensions.install.flash.boards import has_frame
from pebble.extensions.operator.places import Places

DEVICES, SERIAL_PORTS = Path("/dev"), Path("/dev/serial/by-id")
_BAUDS = (460800, 115200)
LISTEN_S = 1.2
_MOST = 65536  # bytes that are looked at
_ENOUGH = 0.8  # of the lines must be readable; the first one is cut off
_KINDS = {b"T": "goob_base_v1", b"C": "goob_base_v1", b"I": "imu_mpu6050_v1", b"S": "imu_mpu6050_v1"}
_LIBCAMERA = ("rpicam-hello", "libcamera-hello")
_CAMERA_S = 10.0
#: What only one file of mosquitto's configuration may set.
_GLOBAL = re.compile(
    r"^\s*(listener|port|password_file|acl_file|allow_anonymous|per_listener_settings|plugin|auth_plugin)\b.*", re.M
)
_POLKIT = ("usr/lib/polkit-1/polkitd", "usr/libexec/polkitd", "usr/lib/policykit-1/polkitd")
_RENEW = "sudo pebble cert renew --folder /etc/pebble/tls"
NO_POLKIT = "polkit is not installed, so the page cannot restart or reboot the robot: sudo apt install polkitd"
NO_MOSQUITTO = "mosquitto is not installed: sudo apt install mosquitto, then sudo pebble setup"
OFFLINE = (
    "This machine has no network, so no phone reaches it: join one, such as by sudo nmtui,"
    f" then {_RENEW} NAME.local ADDRESS"
)


@dataclass(frozen=True, slots=True)
class Board:
    """A serial port, and what was received on it. ``baud`` None: nothing was received, or it could not be opened."""

    port: str
    baud: int | None
    text: str
    protocol: str | None = None  # None: it does not show


def boards(folder: Path, seconds: float = LISTEN_S) -> Iterator[Board]:
    """Listen on each serial port that has a lasting name."""
    for path in sorted(folder.glob("*")):
        yield listen(str(path), seconds)


def listen(port: str, seconds: float) -> Board:
    """Return the board at a port, by what the port sends by itself.

    Nothing is written to it, and its reset lines are not changed.
    """
    try:
        for baud in _BAUDS:
            received = _received(port, baud, seconds)
            if (understood := _understood(received)) is not None:
                protocol, what = understood
                return Board(port, baud, f"{baud} baud, answers, {what}", protocol)
    except (OSError, ValueError) as error:  # SerialException is an OSError
        return Board(port, None, f"cannot be opened: {getattr(error, 'strerror', None) or error}")
    return Board(port, None, "silent")


def _received(port: str, baud: int, seconds: float) -> bytes:
    """Return what a board sends by itself in so many seconds; nothing is sent to it."""
    line = serial.Serial(None, baud, timeout=0.05, exclusive=True)
    line.port, line.dtr, line.rts = port, False, False  # before it is opened: DTR or RTS restarts some boards
    received, end = b"", time.monotonic() + seconds
    with line:  # opens it
        while time.monotonic() < end and len(received) < _MOST:
            received += line.read(4096)
    return received


def _understood(received: bytes) -> tuple[str | None, str] | None:
    """Return the protocol, and what was received in words; None if nothing makes sense at this speed."""
    if b"\0" in received:
        return ("pebble_serial_v1", "frames") if has_frame(received) else None
    lines = [line.strip() for line in received.split(b"\n") if line.strip()]
    readable = [line for line in lines if line.isascii() and line.decode().isprintable()]
    if not readable or len(readable) < _ENOUGH * len(lines):
        return None
    kinds = {line.split()[0] for line in readable}
    known_kinds = sorted(kind for kind in kinds if kind in _KINDS)
    if not known_kinds:
        return None, f"{len(readable)} lines"
    return _KINDS[known_kinds[0]], f"`{'`, `'.join(kind.decode() for kind in known_kinds)}` lines"


def cameras(devices: Path) -> Iterator[str]:
    """Yield the device files of cameras, by lasting names; `libcamera` for one at the board's camera connector.

    A camera's other device files, for its metadata, have names such as ``…-video-index1`` and are left out.
    """
    yield from map(str, sorted((devices / "v4l/by-id").glob("*-video-index0")))
    program = next((name for name in _LIBCAMERA if shutil.which(name)), None)
    if program is not None:
        try:
            done = run([program, "--list-cameras"], _CAMERA_S)
        except (OSError, subprocess.TimeoutExpired):
            return
        if re.search(r"^\s*\d+ : ", done.output + done.errors, re.M):
            yield "libcamera"


def lacks(places: Places) -> Iterator[str]:
    """Yield each part that the robot will lack, with the command that adds it."""
    if not any((places.root / path).exists() for path in _POLKIT):
        yield NO_POLKIT
    result = clock(time.time(), synchronised())
    if result.state is State.FAILED:
        problem = result.text.partition(":")[0]
        yield f"The clock {problem}, so certificates would be refused: {result.fix}, then {_RENEW}"
    if not _has_network():
        yield OFFLINE


def no_broker(places: Places) -> str:
    """Return why the robot's own broker cannot be set up here; empty if it can."""
    if not any((places.root / path).exists() for path in ("usr/sbin/mosquitto", "usr/bin/mosquitto")):
        return NO_MOSQUITTO
    for file in (places.broker.parent.parent / "mosquitto.conf", *sorted(places.broker.parent.glob("*.conf"))):
        if file == places.broker:
            continue
        try:
            match = _GLOBAL.search(file.read_text(encoding="utf-8", errors="replace"))
        except OSError:
            continue
        if match is not None:
            line = match[0].strip().split()[0]
            return f"{places.named(file)} has its own `{line}`: remove it, or answer with the name of that broker"
    if places.root != Path("/"):  # the folder of another machine, whose ports are not those of this one
        return ""
    if places.broker.exists() or _runs("mosquitto"):  # mosquitto itself may have the ports
        return ""
    taken = [port for port in (PLAIN_PORT, PORT) if _is_taken(port)]
    return f"port {taken[0]} is taken by another program: sudo ss -ltnp 'sport = :{taken[0]}' names it" if taken else ""


def _runs(program: str) -> bool:
    for path in Path("/proc").glob("[0-9]*/comm"):
        try:
            if path.read_text(encoding="utf-8").strip() == program:
                return True
        except OSError:
            continue
    return False


def _is_taken(port: int) -> bool:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("", port))
        except OSError:
            return True
    return False


def _has_network() -> bool:
    """True if there is a route to other machines. Sends nothing."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))
        except OSError:
            return False
    return True
