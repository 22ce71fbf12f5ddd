"""Checks the header of a MicroPython image against the board, before the board is erased."""

import struct
from pathlib import Path

from pebble.errors import PebbleError
from pebble.extensions.install.flash.boards import Board

_ESP_MAGIC = 0xE9  # esp-idf, bootloader_support: esp_image_header_t, chip_id at byte 12
_UF2_MAGIC = b"UF2\n\x57\x51\x5d\x9e"
_UF2_HAS_FAMILY = 0x2000
_UF2_SAMD21 = 0x68ED2B88  # github.com/microsoft/uf2, utils/uf2families.json


def check_image(path: Path, board: Board) -> None:
    """Raise PebbleError, with the right download page, unless ``path`` is an image for ``board``."""
    try:
        with path.open("rb") as file:
            header = file.read(512)
    except OSError as error:
        raise PebbleError(f"--micropython {path}: {error.strerror}") from None
    problem = _uf2(header) if board.chip is None else _esp(header, board)  # None: its boot loader takes UF2 files
    if problem:
        raise PebbleError(f"--micropython {path}: {problem}; download {board.download}")


def _esp(header: bytes, board: Board) -> str:
    if len(header) < 16 or header[0] != _ESP_MAGIC:
        return "not an image for an Espressif chip"
    chip_id = struct.unpack_from("<H", header, 12)[0]
    if board.chip_id is not None and chip_id != board.chip_id:
        return f"an image for another chip than {board.chip}"
    return ""


def _uf2(header: bytes) -> str:
    if len(header) < 512 or not header.startswith(_UF2_MAGIC):
        return "not a UF2 file"
    flags, family = struct.unpack_from("<I", header, 8)[0], struct.unpack_from("<I", header, 28)[0]
    if flags & _UF2_HAS_FAMILY and family != _UF2_SAMD21:
        return "an image for another chip than SAMD21"
    return ""
