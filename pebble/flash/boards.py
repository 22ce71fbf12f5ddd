"""The boards that firmware exists for, and which robot is built on which."""

from __future__ import annotations

from binascii import crc_hqx
from collections.abc import Callable
from dataclasses import dataclass

from pebble.errors import PebbleError


@dataclass(frozen=True, slots=True, kw_only=True)
class Board:
    """One board, as MicroPython and its tools know it."""

    title: str  # what is printed on the package
    build: str  # MicroPython's name for it, and of the page on micropython.org
    variant: str = ""  # of that build, if it is not the plain one
    machine: str  # occurs in ``sys.implementation._machine`` there
    port: str  # MicroPython's port, also the name of its type stubs
    arch: str  # mpy-cross -march
    chip: str | None = None  # esptool --chip; None: the board shows a drive for UF2 files instead
    chip_id: int | None = None  # in an ESP image's header; None: the header has none (ESP8266)
    offset: str = "0x0"  # where its image starts in flash
    baud: int = 460800  # esptool's, what every USB-serial chip of these boards can do
    #: Plenty of memory? Else the code goes without line numbers, which are four per cent of it.
    roomy: bool = False

    @property
    def download(self) -> str:
        """Where the right MicroPython is to be had, for people."""
        file = "-".join(filter(None, (self.build, self.variant)))
        return f"{file} at https://micropython.org/download/{self.build}"


_HEADER = 13  # bytes before the payload of a frame

SAMD21 = Board(title="Seeed XIAO SAMD21", build="SEEED_XIAO_SAMD21", machine="SAMD21", port="samd", arch="armv6m")
ESP32_C6 = Board(
    title="Seeed XIAO ESP32-C6",
    build="ESP32_GENERIC_C6",
    machine="ESP32C6",
    port="esp32",
    arch="rv32imc",
    chip="esp32c6",
    chip_id=13,
    roomy=True,
)
ESP8266 = Board(
    title="Wemos D1 mini (ESP8266)",
    build="ESP8266_GENERIC",
    machine="ESP8266",
    port="esp8266",
    variant="FLASH_2M_ROMFS",  # code runs from flash, and leaves 9 KB of 36 to the robot
    arch="xtensa",
    chip="esp8266",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Firmware:
    """One folder of firmware/: the robot it makes out of a board."""

    name: str
    board: Board
    baud: int = 115200  # of the line to the host, for those on one
    #: Does this, heard on that line, hold one of its reports? None: it talks to a broker.
    is_report: Callable[[bytes], bool] | None = None
    #: Where it speaks instead of on USB, if the board lacks ``sys.stdin.buffer`` as the official SAMD21 image does.
    elsewhere: str = ""


def _lines(beginning: bytes) -> Callable[[bytes], bool]:
    """Reports of goob_base_v1."""
    return lambda heard: any(line.startswith(beginning) for line in heard.split(b"\n")[1:-1])


def _frames(heard: bytes) -> bool:
    """Frames of pebble_serial_v1 end with a zero: COBS(body, CRC-16/CCITT-FALSE)."""
    return any(_is_frame(frame) for frame in heard.split(b"\0")[1:-1])


def _is_frame(cobs: bytes) -> bool:
    plain, at = b"", 0
    while at < len(cobs):
        run = cobs[at]
        plain += cobs[at + 1 : at + run] + b"\0" * (run < 255)
        at += run
    body, check = plain[:-3], plain[-3:-1]  # the last zero is COBS's own
    return len(body) >= _HEADER and crc_hqx(body, 0xFFFF).to_bytes(2, "little") == check


FIRMWARE = {
    firmware.name: firmware
    for firmware in (
        Firmware(name="minilamp", board=ESP32_C6),
        Firmware(name="benjr", board=ESP8266),
        Firmware(name="goob", board=SAMD21, baud=460800, is_report=_lines(b"T a0=")),
        Firmware(name="fred", board=SAMD21, is_report=_lines(b"T t0=")),
        Firmware(name="goob_imu", board=SAMD21, is_report=_frames, elsewhere="D6 and D7, 115200 baud"),
    )
}


def firmware_named(name: str) -> Firmware:
    """Raises PebbleError that lists what there is."""
    if name not in FIRMWARE:
        raise PebbleError(f"there is no firmware called {name}, only {', '.join(sorted(FIRMWARE))}")
    return FIRMWARE[name]
