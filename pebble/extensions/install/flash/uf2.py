"""Installs MicroPython on a SAMD21 by copying a file to the USB drive of its boot loader."""

import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import serial

from pebble.errors import DeviceError
from pebble.runtime.as_owner import as_owner

_INFO = "INFO_UF2.TXT"  # every UF2 boot loader has it: github.com/microsoft/uf2
_MOUNTS = Path("/proc/self/mounts")
_LABELS = ("Arduino", "Seeed XIAO", "XIAO")  # of the drive, on boards of different years
_TOUCH_BAUD = 1200
_AUTOMATIC_S = 4.0  # then the user is asked for help


def enter_boot_loader(port: str) -> None:
    """Request the boot loader by opening the port at 1200 baud and closing it; Arduino and MicroPython support this."""
    with suppress(OSError, serial.SerialException), serial.Serial(port, _TOUCH_BAUD) as line:
        line.dtr = line.rts = False  # both: shared/tinyusb/mp_usbd_cdc.c, tud_cdc_line_state_cb


def wait_for_drive(ask: Callable[[str], None], mounts: Path = _MOUNTS, timeout_s: float = 90.0) -> Path:
    """Return the folder where the drive is mounted. Raises DeviceError when it does not appear."""
    begin, asked = time.monotonic(), False
    while time.monotonic() < begin + timeout_s:
        for folder in _mounted(mounts):
            if _is_boot_loader(folder):
                return folder
        if not asked and time.monotonic() > begin + _AUTOMATIC_S:
            asked = True
            ask("waiting for the drive: reset twice, quickly (on a XIAO: join the two RST pads with a wire, twice)")
            for device in _unmounted():
                ask(f"the drive is not mounted: sudo mount -o uid=$(id -u) {device} /mnt")
        time.sleep(0.2)
    raise DeviceError("the boot loader's drive did not appear; see docs/firmware.md, Seeed XIAO SAMD21")


def copy(image: Path, drive: Path) -> None:
    """Copy the image; errors are ignored once the board has started MicroPython, which removes the drive."""
    try:
        with image.open("rb") as source, as_owner(drive), (drive / image.name).open("wb") as target:
            shutil.copyfileobj(source, target)
    except OSError as error:
        if drive.exists() and _is_boot_loader(drive):
            raise DeviceError(f"copying {image.name} to {drive}: {error.strerror}") from None


def _mounted(mounts: Path) -> Iterator[Path]:
    for line in mounts.read_text(encoding="utf-8").splitlines() if mounts.exists() else ():
        device, folder, kind, *_ = line.split()
        if kind in ("vfat", "msdos") or device.startswith("/dev/sd"):
            yield Path(folder.encode().decode("unicode_escape"))  # spaces are \040
    yield from Path("/Volumes").glob("*")  # macOS


def _is_boot_loader(folder: Path) -> bool:
    with suppress(OSError):
        return "SAMD21" in (folder / _INFO).read_text(errors="replace", encoding="utf-8")
    return False


def _unmounted() -> list[Path]:
    labels = (Path("/dev/disk/by-label", label.replace(" ", "\\x20")) for label in _LABELS)
    return [label.resolve() for label in labels if label.exists()]
