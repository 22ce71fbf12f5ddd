"""A wrong file is refused before the board is erased."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from pebble.errors import PebbleError
from pebble.extensions.install.flash.boards import ESP32_C6, ESP8266, SAMD21
from pebble.extensions.install.flash.images import check_image


def esp(chip: int) -> bytes:
    return struct.pack("<BBBBIB3xH", 0xE9, 3, 2, 0x20, 0x40000000, 0xEE, chip) + bytes(500)


def uf2(family: int, flags: int = 0x2000) -> bytes:
    head = struct.pack("<8I", 0x0A324655, 0x9E5D5157, flags, 0x2000, 256, 0, 1, family)
    return head + bytes(476) + struct.pack("<I", 0x0AB16F30)


@pytest.mark.parametrize(
    ("board", "content"), [(ESP32_C6, esp(13)), (ESP8266, esp(0)), (SAMD21, uf2(0x68ED2B88)), (SAMD21, uf2(0, flags=0))]
)
def test_an_image_for_the_board_is_accepted(board, content: bytes, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    image = tmp_path / "image"
    image.write_bytes(content)
    check_image(image, board)


@pytest.mark.parametrize(
    ("board", "content", "problem"),
    [
        (ESP32_C6, esp(9), "an image for another chip than esp32c6"),  # an ESP32-S3
        (ESP32_C6, uf2(0x68ED2B88), "not an image for an Espressif chip"),
        (ESP8266, b"", "not an image for an Espressif chip"),
        (SAMD21, uf2(0xE48BFF56), "an image for another chip than SAMD21"),  # an RP2040
        (SAMD21, esp(13), "not a UF2 file"),
    ],
)
def test_an_image_for_another_board_is_refused(board, content: bytes, problem: str, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    image = tmp_path / "image"
    image.write_bytes(content)
    with pytest.raises(
        PebbleError, match=rf"image: {problem}; download .*{board.build}.*/micropython.org/download/{board.build}"
    ):
        check_image(image, board)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(PebbleError, match="No such file"):
        check_image(tmp_path / "nothing.bin", SAMD21)
