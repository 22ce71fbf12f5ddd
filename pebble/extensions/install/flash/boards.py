"""The boards for which firmware exists, and the board of each robot."""

from collections.abc import Callable
from dataclasses import dataclass

from pebble.errors import PebbleError
from pebble.services.serial_mcu_bridge.pebble_serial_v1.frame import FrameError, decode


@dataclass(frozen=True, slots=True, kw_only=True)
class Board:
    """A board type, with its names in MicroPython, esptool and mpy-cross."""

    title: str  # what is printed on the package
    build: str  # MicroPython's name of the board, and of its download page on micropython.org
    variant: str = ""  # of that build; "": the default one
    machine: str  # part of ``sys.implementation._machine`` on this board
    port: str  # MicroPython's port, also the name of its type stubs
    arch: str  # mpy-cross -march
    chip: str | None = None  # esptool --chip; None: the boot loader is a USB drive that takes UF2 files
    chip_id: int | None = None  # in the header of an ESP image; None: the header has none (ESP8266)
    offset: str = "0x0"  # start address of the image in flash
    baud: int = 460800  # for esptool; every USB-serial chip of these boards supports it
    #: True: compiled code keeps its line numbers, which are four per cent of its size.
    has_much_memory: bool = False

    @property
    def download(self) -> str:
        """File name and download page of the right MicroPython, for messages."""
        file = "-".join(filter(None, (self.build, self.variant)))
        return f"{file} at https://micropython.org/download/{self.build}"


SAMD21 = Board(title="Seeed XIAO SAMD21", build="SEEED_XIAO_SAMD21", machine="SAMD21", port="samd", arch="armv6m")
ESP32_C6 = Board(
    title="Seeed XIAO ESP32-C6",
    build="ESP32_GENERIC_C6",
    machine="ESP32C6",
    port="esp32",
    arch="rv32imc",
    chip="esp32c6",
    chip_id=13,
    has_much_memory=True,
)
ESP8266 = Board(
    title="Wemos D1 mini (ESP8266)",
    build="ESP8266_GENERIC",
    machine="ESP8266",
    port="esp8266",
    variant="FLASH_2M_ROMFS",  # code runs from flash, which leaves more of the 36 KB of RAM free
    arch="xtensa",
    chip="esp8266",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Firmware:
    """The firmware of one robot: its folder of firmware/, and its board."""

    name: str
    board: Board
    baud: int = 115200  # of the serial line to the host
    #: True if bytes from the serial line contain one of its reports. None: the robot connects to a broker instead.
    is_report: Callable[[bytes], bool] | None = None
    #: Serial port used instead of USB on an image without ``sys.stdin.buffer``, such as the official SAMD21 one.
    fallback_port: str = ""

    @property
    def has_wifi(self) -> bool:
        """True if the robot connects to a broker; else a host reads its reports from the serial line."""
        return self.is_report is None


def _lines(beginning: bytes) -> Callable[[bytes], bool]:
    """Return a check for complete lines of goob_base_v1 that begin with ``beginning``."""
    return lambda received: any(line.startswith(beginning) for line in received.split(b"\n")[1:-1])


def has_frame(received: bytes) -> bool:
    """True if a whole frame of pebble_serial_v1 was received."""
    return any(map(_is_frame, received.split(b"\0")))


def _is_frame(stuffed: bytes) -> bool:
    try:
        decode(stuffed)
    except FrameError:
        return False
    return True


FIRMWARE = {
    firmware.name: firmware
    for firmware in (
        Firmware(name="minilamp", board=ESP32_C6),
        Firmware(name="benjr", board=ESP8266),
        Firmware(name="goob", board=SAMD21, baud=460800, is_report=_lines(b"T a0=")),
        Firmware(name="fred", board=SAMD21, is_report=_lines(b"T t0=")),
        Firmware(name="goob_imu", board=SAMD21, is_report=has_frame, fallback_port="D6 and D7, 115200 baud"),
    )
}


def firmware_named(name: str) -> Firmware:
    """Return the firmware of this name. Raises PebbleError that lists the known names."""
    if name not in FIRMWARE:
        raise PebbleError(f"unknown firmware {name}; known: {', '.join(sorted(FIRMWARE))}")
    return FIRMWARE[name]
