"""What is at this machine: boards, which are listened to and never written to, cameras, and what a robot needs."""

import fcntl
import os
import re
import shutil
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import serial

from pebble.checks.check import State
from pebble.checks.machine import clock, synchronised
from pebble.fleet.folder import PLAIN_PORT, PORT
from pebble.services.serial_mcu_bridge.pebble_serial_v1.frame import FrameError, decode
from pebble.setup.places import Places

DEVICES, SERIAL_PORTS = Path("/dev"), Path("/dev/serial/by-id")
BAUDS = (460800, 115200)
LISTEN_S = 1.2
_MOST = 65536  # bytes that are looked at
_ENOUGH = 0.8  # of the lines must be readable; the first one is cut off
_KINDS = {b"T": "goob_base_v1", b"C": "goob_base_v1", b"I": "imu_mpu6050_v1", b"S": "imu_mpu6050_v1"}
_LIBCAMERA = ("rpicam-hello", "libcamera-hello")
_CAMERA_S = 10.0
#: Linux, videodev2.h: what `VIDIOC_QUERYCAP` answers, and that a device file captures pictures.
_QUERYCAP, _QUERYCAP_BYTES, _DEVICE_CAPS_AT, _CAPTURES = 0x80685600, 104, 88, 0x1 | 0x1000
#: What only one file of mosquitto's configuration may set.
_GLOBAL = re.compile(
    r"^\s*(listener|port|password_file|acl_file|allow_anonymous|per_listener_settings|plugin|auth_plugin)\b.*", re.M
)


@dataclass(frozen=True, slots=True)
class Board:
    """A serial port, and what was received there. ``baud`` None: it was silent, or could not be opened."""

    port: str
    baud: int | None
    text: str
    protocol: str | None = None  # None: it does not show


def boards(folder: Path, bauds: Sequence[int] = BAUDS, seconds: float = LISTEN_S) -> Iterator[Board]:
    """Listen to each serial port that has a name that stays."""
    for path in sorted(folder.glob("*")):
        yield listen(str(path), bauds, seconds)


def listen(port: str, bauds: Sequence[int] = BAUDS, seconds: float = LISTEN_S) -> Board:
    """What a port sends by itself. Nothing is written to it, and its reset lines stay as they are."""
    try:
        for baud in bauds:
            received = _received(port, baud, seconds)
            if (found := _understood(received)) is not None:
                protocol, what = found
                return Board(port, baud, f"{baud} baud, answers, {what}", protocol)
    except (OSError, ValueError) as error:  # SerialException is an OSError
        return Board(port, None, f"cannot be opened: {getattr(error, 'strerror', None) or error}")
    return Board(port, None, "silent")


def _received(port: str, baud: int, seconds: float) -> bytes:
    line = serial.Serial(None, baud, timeout=0.05, exclusive=True)
    line.port, line.dtr, line.rts = port, False, False  # some boards start anew at each of them
    received, end = b"", time.monotonic() + seconds
    with line:
        while time.monotonic() < end and len(received) < _MOST:
            received += line.read(4096)
    return received


def _understood(received: bytes) -> tuple[str | None, str] | None:
    """The protocol and what was received, in words; None: nothing that makes sense at this speed."""
    if b"\0" in received:
        return ("pebble_serial_v1", "frames") if any(map(_is_frame, received.split(b"\0"))) else None
    lines = [line.strip() for line in received.split(b"\n") if line.strip()]
    readable = [line for line in lines if line.isascii() and line.decode().isprintable()]
    if not readable or len(readable) < _ENOUGH * len(lines):
        return None
    kinds = {line.split()[0] for line in readable}
    known = sorted(kind for kind in kinds if kind in _KINDS)
    if not known:
        return None, f"{len(readable)} lines"
    return _KINDS[known[0]], f"`{'`, `'.join(kind.decode() for kind in known)}` lines"


def _is_frame(stuffed: bytes) -> bool:
    try:
        decode(stuffed)
    except FrameError:
        return False
    return True


def cameras(devices: Path) -> Iterator[str]:
    """Device files that capture pictures, by names that stay; `libcamera` for one at the board's own connector."""
    yield from (str(link) for link in sorted((devices / "v4l/by-id").glob("*")) if captures(link))
    program = next((name for name in _LIBCAMERA if shutil.which(name)), None)
    if program is not None:
        try:
            done = subprocess.run(
                [program, "--list-cameras"], capture_output=True, text=True, check=False, timeout=_CAMERA_S
            )
        except (OSError, subprocess.TimeoutExpired):
            return
        if re.search(r"^\s*\d+ : ", done.stdout + done.stderr, re.M):
            yield "libcamera"


def captures(device: Path) -> bool:
    """Whether a device file gives pictures; a camera has others, of its metadata."""
    answer = bytearray(_QUERYCAP_BYTES)
    try:
        descriptor = os.open(device, os.O_RDWR | os.O_NONBLOCK)
    except OSError:
        return False
    try:
        fcntl.ioctl(descriptor, _QUERYCAP, answer)
    except OSError:
        return False
    finally:
        os.close(descriptor)
    return bool(struct.unpack_from("<I", answer, _DEVICE_CAPS_AT)[0] & _CAPTURES)


@dataclass(frozen=True, slots=True, kw_only=True)
class Machine:
    """What a robot needs of its machine, each empty if all is well, else why it lacks and what to do."""

    systemd: str = ""
    unit: str = ""
    mosquitto: str = ""
    polkit: str = ""
    writable: str = ""
    bits: str = ""
    clock: str = ""
    network: str = ""

    def lacks(self) -> list[str]:
        """What no step depends on, in words."""
        return [text for text in (self.bits, self.clock, self.network) if text]


def machine(places: Places) -> Machine:
    """Look at the machine whose root this is."""
    root = places.root
    units = ("etc/systemd/system", "usr/lib/systemd/system", "lib/systemd/system")
    installed = any((root / folder / "pebble.service").exists() for folder in units)
    polkit = ("usr/lib/polkit-1/polkitd", "usr/libexec/polkitd", "usr/lib/policykit-1/polkitd")
    return Machine(
        systemd="" if (root / "run/systemd/system").is_dir() or not places.is_live else NO_SYSTEMD,
        unit="" if installed else NO_UNIT,
        mosquitto=_mosquitto(places),
        polkit="" if any((root / path).exists() for path in polkit) else NO_POLKIT,
        writable=unwritable(places),
        bits=bits(sys.maxsize),
        clock=unset_clock(time.time(), synchronised()),
        network="" if _has_network() else OFFLINE,
    )


RENEW = "sudo pebble cert renew --folder /etc/pebble/tls"
NO_UNIT = (
    "pebble.service is not installed, so nothing starts the robot with the machine:"
    " sudo apt install ./pebble-robot_….deb, then sudo pebble setup"
)
NO_SYSTEMD = "systemd does not run here, so nothing starts the robot with the machine: pebble up /etc/pebble/robot.json"
NO_POLKIT = (
    "polkit is not installed, so the page cannot restart or reboot the robot:"
    " sudo apt install polkitd, then sudo pebble setup"
)
NO_MOSQUITTO = (
    "mosquitto is not installed, so there is no broker on this robot:"
    " sudo apt install mosquitto, then sudo pebble setup"
)
OFFLINE = (
    "this machine has no network, so no phone reaches it: join one, such as by sudo nmtui,"
    f" then {RENEW} NAME.local ADDRESS"
)


def bits(largest: int) -> str:
    """``largest``: of a C pointer's size."""
    if largest > 2**32:
        return ""
    return "this system has 32 bits, for which the versions of packages are not locked: install one of 64 bits"


def unset_clock(now: float, known: bool | None) -> str:
    found = clock(now, known)
    if found.state is not State.FAILED:
        return ""
    return f"the clock {found.text.partition(':')[0]}, so certificates would be refused: {found.fix}, then {RENEW}"


def unwritable(places: Places) -> str:
    """Why nothing can be written below the root, for whatever user; empty: it can."""
    folder = next(one for one in (places.etc, *places.etc.parents) if one.exists())
    if os.statvfs(folder).f_flag & os.ST_RDONLY:
        return f"{folder} is read-only: sudo mount -o remount,rw {mount_point(folder)}, then sudo pebble setup"
    return ""


def mount_point(path: Path) -> Path:
    """Where the file system of the path is mounted: `mount` takes no other folder."""
    lines = Path("/proc/self/mounts").read_text(encoding="utf-8", errors="surrogateescape").splitlines()
    points = {Path(re.sub(r"\\([0-7]{3})", lambda found: chr(int(found[1], 8)), line.split()[1])) for line in lines}
    return next((folder for folder in (path, *path.parents) if folder in points), Path("/"))


def _mosquitto(places: Places) -> str:
    """Why the robot's own broker cannot be made here."""
    if not any((places.root / path).exists() for path in ("usr/sbin/mosquitto", "usr/bin/mosquitto")):
        return NO_MOSQUITTO
    for file in (places.broker.parent.parent / "mosquitto.conf", *sorted(places.broker.parent.glob("*.conf"))):
        if file == places.broker:
            continue
        try:
            found = _GLOBAL.search(file.read_text(encoding="utf-8", errors="replace"))
        except OSError:
            continue
        if found is not None:
            line = found[0].strip().split()[0]
            return f"{places.named(file)} has its own `{line}`: remove it, or give --broker the name of that broker"
    if not places.is_live or places.broker.exists() or _runs("mosquitto"):
        return ""
    taken = next((port for port in (PLAIN_PORT, PORT) if _is_taken(port)), None)
    return (
        "" if taken is None else f"port {taken} is taken by another program: sudo ss -ltnp 'sport = :{taken}' names it"
    )


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
    """Whether there is a way to other machines; sends nothing."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))
        except OSError:
            return False
    return True
