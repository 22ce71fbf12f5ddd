"""The variants of sending frames, what each needs, and the processes that it consists of."""

from __future__ import annotations

import functools
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pebble.errors import PebbleError
from pebble.rig.broker import BrokerKind, best_kind

VARIANTS = ("zenoh-shm", "zenoh-copy", "zenoh-net", "mqtt", "gstreamer-shm", "memcpy")
ABOUT = {
    "zenoh-shm": "created in the shared segment, read as a view: no copy",
    "zenoh-copy": "shared memory, one copy in and one out",
    "zenoh-net": "Zenoh without shared memory",
    "mqtt": "mosquitto and paho, QoS 0",
    "gstreamer-shm": "shmsink and shmsrc, created in the segment, one copy out",
    "memcpy": "no transport: a bare copy of as many bytes between two frames",
}
INSTALL_GSTREAMER = (
    "apt-get install -y --no-install-recommends gstreamer1.0-plugins-base gstreamer1.0-plugins-bad"
    " gir1.2-gst-plugins-base-1.0 python3-gst-1.0 python3-numpy"
)
_INSTALL_MOSQUITTO = "apt-get install -y --no-install-recommends mosquitto"
_SYSTEM_PYTHON = "/usr/bin/python3"  # the only one that Debian's gi and Gst can be imported into
_PROBE = """
import gi, numpy
gi.require_version("Gst", "1.0")
gi.require_version("GstApp", "1.0")
from gi.repository import Gst, GstApp
Gst.init(None)
for name in ("shmsink", "shmsrc", "appsrc", "appsink"):
    assert Gst.ElementFactory.find(name), name
"""
_PROBE_S = 20.0


@dataclass(frozen=True, slots=True)
class Size:
    """A picture in BGR, three bytes per pixel."""

    width: int
    height: int

    def __str__(self) -> str:
        return f"{self.width}x{self.height}"

    @property
    def bytes(self) -> int:
        return 3 * self.width * self.height


def parse_size(text: str) -> Size:
    """``640x480`` or ``640×480``. Raises PebbleError."""
    width, _, height = text.replace("×", "x").partition("x")
    if not (width.isdecimal() and height.isdecimal()) or not 8 <= int(width) * int(height) <= 10**8:
        raise PebbleError(f"not a size: {text} (example: 640x480)")
    if int(width) % 4:
        raise PebbleError(f"{text}: the width must be a multiple of 4, or GStreamer pads the rows")
    return Size(int(width), int(height))


@dataclass(frozen=True, slots=True)
class Case:
    """One cell of the comparison."""

    variant: str
    size: Size
    readers: int
    role: str = ""  # replaces the variant's name where one variant has several roles
    slower_us: float = 0.0  # how long the writer delays each frame

    def __str__(self) -> str:
        return f"{self.name} {self.size}, {readers(self.readers)}"

    @property
    def name(self) -> str:
        return self.role or self.variant

    @property
    def needs_broker(self) -> bool:
        return self.variant == "mqtt"

    @property
    def needs_writer_first(self) -> bool:
        """Whether readers fail without a writer, as shmsrc does; the others wait."""
        return self.variant == "gstreamer-shm"

    def command(self, role: str, folder: Path, port: int) -> list[str]:
        """The command of the ``role`` (writer or reader); ``folder`` is for sockets, ``port`` is the broker's."""
        if self.variant == "gstreamer-shm":
            program = str(Path(__file__).with_name("frames_gstreamer.py"))
            where = [str(folder / "gst.sock"), str(self.size.width), str(self.size.height)]
            return [_SYSTEM_PYTHON, program, role, *where, str(self.slower_us)]
        where = [str(port) if self.needs_broker else str(folder), str(self.size)]
        return [sys.executable, "-m", "pebble.bench.frames_worker", self.variant, role, *where, str(self.slower_us)]


def readers(count: int) -> str:
    """``one reader``, ``3 readers``."""
    return "one reader" if count == 1 else f"{count} readers"


def missing(variant: str) -> str | None:
    """Why this variant cannot run on this machine, with the command that installs it; None if it can."""
    check = _NEEDS.get(variant)
    return check() if check is not None else None


def _mosquitto() -> str | None:
    try:
        installed = best_kind() is BrokerKind.MOSQUITTO
    except PebbleError:
        installed = False
    return None if installed else f"mosquitto is not installed: {_INSTALL_MOSQUITTO}"


@functools.cache
def _gstreamer() -> str | None:
    try:
        probe = subprocess.run([_SYSTEM_PYTHON, "-c", _PROBE], capture_output=True, timeout=_PROBE_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"{error}; GStreamer is read by {_SYSTEM_PYTHON}: {INSTALL_GSTREAMER}"
    return None if probe.returncode == 0 else f"GStreamer is not installed: {INSTALL_GSTREAMER}"


_NEEDS: dict[str, Callable[[], str | None]] = {"mqtt": _mosquitto, "gstreamer-shm": _gstreamer}
