"""Finding a board's port, and interrupting the program on the board."""

from __future__ import annotations

import os
import threading
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest

from pebble.errors import DeviceError
from pebble.extensions.install.flash import ports, uf2
from tests.ext.install.flash.board import NodeBoard


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


def test_a_prompt_is_found_at_once() -> None:
    asked: list[str] = []
    with NodeBoard() as board:
        ports.break_in(board.port, asked.append, pulse=False)
    assert asked == []


def test_the_user_is_asked_to_reset_a_board_that_does_not_listen(
    uninterruptible: UninterruptibleBoard, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ports, "_AUTOMATIC_S", 0.3)
    ports.break_in(uninterruptible.port, uninterruptible.ask, pulse=True, timeout_s=10)
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
    monkeypatch.setattr(ports, "described", list)
    assert "no board is plugged in" in ports.hint()


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
