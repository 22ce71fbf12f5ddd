"""Finding a board's port, interrupting its program, and whether the board and the image fit."""

from __future__ import annotations

import os
import struct
import threading
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest

from pebble.errors import DeviceError, PebbleError
from pebble.extensions.install.flash import ports, uf2
from pebble.extensions.install.flash.boards import ESP32_C6, ESP8266, SAMD21, Board
from pebble.extensions.install.flash.images import check_image
from pebble.extensions.install.flash.on_board import check_answer
from tests.support import WAIT_S


def esp(chip: int) -> bytes:
    return struct.pack("<BBBBIB3xH", 0xE9, 3, 2, 0x20, 0x40000000, 0xEE, chip) + bytes(500)


def uf2_image(family: int, flags: int = 0x2000) -> bytes:
    head = struct.pack("<8I", 0x0A324655, 0x9E5D5157, flags, 0x2000, 256, 0, 1, family)
    return head + bytes(476) + struct.pack("<I", 0x0AB16F30)


#: A board, an image, and why it is refused; empty: it is accepted.
IMAGES = [
    (ESP32_C6, esp(13), ""),
    (ESP8266, esp(0), ""),
    (SAMD21, uf2_image(0x68ED2B88), ""),
    (SAMD21, uf2_image(0, flags=0), ""),
    (ESP32_C6, esp(9), "an image for another chip than esp32c6"),  # an ESP32-S3
    (ESP8266, b"", "not an image for an Espressif chip"),
    (SAMD21, uf2_image(0xE48BFF56), "an image for another chip than SAMD21"),  # an RP2040
    (SAMD21, esp(13), "not a UF2 file"),
]


@pytest.mark.parametrize(("board", "content", "problem"), IMAGES)
def test_an_image_is_for_the_board_or_refused(board: Board, content: bytes, problem: str, tmp_path: Path) -> None:
    image = tmp_path / "image"
    image.write_bytes(content)
    if not problem:
        check_image(image, board)
        return
    with pytest.raises(PebbleError, match=f"image: {problem}; download .*/micropython.org/download/{board.build}"):
        check_image(image, board)


@pytest.mark.parametrize(
    ("board", "answer", "binary"),
    [
        (SAMD21, "micropython (1, 29, 0) 774 False 0 Seeed Xiao with SAMD21G18A\r\n", False),
        (ESP8266, "MPY: soft reboot\r\nmicropython (1, 28, 0) 9990 True 1032192 ESP module with ESP8266\r\n", True),
    ],
)
def test_the_answers_of_our_boards_are_parsed(board: Board, answer: str, binary: bool) -> None:
    info = check_answer(answer, board)
    assert info.binary is binary
    assert info.text.startswith("MicroPython 1.2")


@pytest.mark.parametrize(
    ("answer", "problem"),
    [
        ("micropython (1, 29, 0) 774 True 0 ESP32C3 module with ESP32C3", "the board is a ESP32C3 module"),
        ("micropython (1, 21, 0) 262 True 0 ESP32C6 with ESP32C6", r"1\.21\.0 on the board cannot load our \.mpy"),
        ("circuitpython (9, 2, 0) 517 True 0 ESP32C6", "the board runs circuitpython"),
        ("", "unexpected answer"),
    ],
)
def test_other_boards_are_refused(answer: str, problem: str) -> None:
    with pytest.raises(PebbleError, match=problem):
        check_answer(answer, ESP32_C6)


class UninterruptibleBoard:
    """A board whose firmware ignores Ctrl-C until the board is reset."""

    def __init__(self) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self.asked: list[str] = []
        self._was_reset = threading.Event()
        threading.Thread(target=self._live, daemon=True).start()

    def ask(self, text: str) -> None:
        self.asked.append(text)
        self._was_reset.set()

    def close(self) -> None:
        os.close(self._slave)

    def _live(self) -> None:
        try:
            while data := os.read(self._master, 64):
                if self._was_reset.is_set() and b"\x03" in data:
                    os.write(self._master, b"KeyboardInterrupt:\r\nMicroPython v1.29.0\r\n>>> ")
        except OSError:
            pass


@pytest.fixture
def uninterruptible() -> Iterator[UninterruptibleBoard]:
    board = UninterruptibleBoard()
    yield board
    board.close()


def test_the_user_is_asked_to_reset_a_board_that_does_not_listen(
    uninterruptible: UninterruptibleBoard, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ports, "_AUTOMATIC_S", 0.3)
    ports.break_in(uninterruptible.port, uninterruptible.ask, pulse=True, timeout_s=WAIT_S)
    assert len(uninterruptible.asked) == 1
    assert "press its reset button" in uninterruptible.asked[0]


def test_a_board_without_micropython_is_an_error(
    uninterruptible: UninterruptibleBoard, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ports, "_AUTOMATIC_S", 0.1)
    with pytest.raises(DeviceError, match=r"MicroPython does not answer; .* --micropython"):
        ports.break_in(uninterruptible.port, lambda _: None, pulse=False, timeout_s=0.5)


def test_a_missing_port_lists_the_available_ones(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(ports, "described", lambda: ["/dev/ttyACM0  Seeed XIAO M0 [2886:802f]"])
    with pytest.raises(
        DeviceError, match=r"/dev/ttyNOWHERE: does not exist; available ports:\n  /dev/ttyACM0  Seeed XIAO M0"
    ):
        ports.check("/dev/ttyNOWHERE")
    with pytest.raises(DeviceError, match="is not a serial port"):
        ports.check(str(tmp_path))


def test_the_boot_loaders_drive_is_distinguished_from_others(tmp_path: Path) -> None:
    stick, drive = tmp_path / "stick", tmp_path / "Seeed XIAO"
    stick.mkdir()
    drive.mkdir()
    (drive / "INFO_UF2.TXT").write_text("UF2 Bootloader v1.1.2\nModel: Seeeduino XIAO\nBoard-ID: SAMD21G18A-XIAO-v0\n")
    mounts = tmp_path / "mounts"
    names = [str(folder).replace(" ", "\\040") for folder in (stick, drive)]
    mounts.write_text(f"/dev/sda1 {names[0]} vfat rw 0 0\n/dev/sdb {names[1]} vfat rw 0 0\nproc /proc proc rw 0 0\n")
    image = tmp_path / "firmware.uf2"
    image.write_bytes(b"x" * 2000)
    found = uf2.wait_for_drive(lambda _: None, mounts, timeout_s=1)
    uf2.copy(image, found)
    assert found == drive
    assert (drive / "firmware.uf2").read_bytes() == image.read_bytes()
