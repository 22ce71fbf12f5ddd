"""Every module of every robot compiles for its board, and fits onto it."""

from __future__ import annotations

from pathlib import Path

import pytest

from pebble.extensions.install.flash.boards import FIRMWARE
from pebble.extensions.install.flash.on_board import MPY_VERSION
from pebble.extensions.install.flash.sources import firmware_folder, modules
from tests.firmware.micropython import compile_module

pytestmark = pytest.mark.computing

#: Bytes of the file system on a XIAO SAMD21: 256 KB of flash less 8 for the boot loader and 184 for MicroPython.
SMALLEST_DISK = 64 * 1024


@pytest.mark.parametrize("robot", FIRMWARE)
def test_a_robots_modules_compile_for_its_board(robot: str, tmp_path: Path) -> None:
    firmware = FIRMWARE[robot]
    compiled = [compile_module(firmware, module, tmp_path) for module in modules(firmware)]
    heads = {file.read_bytes()[:4] for file in compiled}
    # version; sub-version and architecture count for native code only, and there is none; bits of a small integer
    assert heads == {bytes((ord("M"), MPY_VERSION[0], 0, 31))}
    assert sum(file.stat().st_size for file in compiled) < SMALLEST_DISK / 2


def test_every_file_belongs_to_a_robot() -> None:
    used = {module for firmware in FIRMWARE.values() for module in modules(firmware)}
    used |= {Path(name, "main.py") for name in FIRMWARE}
    there = {path.relative_to(firmware_folder()) for path in firmware_folder().glob("*/*.py")}
    assert there - used == set()


def test_a_robot_gets_nothing_that_it_does_not_import() -> None:
    names = {module.name for module in modules(FIRMWARE["goob"])}
    assert {"robot.py", "pins.py", "lines.py", "drv8833.py"} <= names
    assert not {"mqtt.py", "wifi.py", "frames.py"} & names
