"""The answer of a board about itself is parsed and checked."""

from __future__ import annotations

import pytest

from pebble.errors import PebbleError
from pebble.extensions.install.flash.boards import ESP32_C6, ESP8266, SAMD21, Board
from pebble.extensions.install.flash.on_board import check_answer


@pytest.mark.parametrize(
    ("board", "answer", "binary"),
    [
        (SAMD21, "micropython (1, 29, 0) 774 False 0 Seeed Xiao with SAMD21G18A\r\n", False),
        (ESP32_C6, "micropython (1, 29, 0) 11014 True 0 ESP32C6 module with ESP32C6\r\n", True),
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
        (
            "micropython (1, 21, 0) 262 True 0 ESP32C6 module with ESP32C6",
            r"1\.21\.0 on the board cannot load our \.mpy",
        ),
        ("circuitpython (9, 2, 0) 517 True 0 ESP32C6", "the board runs circuitpython"),
        ("Traceback (most recent call last):", "unexpected answer"),
        ("", "unexpected answer"),
    ],
)
def test_other_boards_are_refused(answer: str, problem: str) -> None:
    with pytest.raises(PebbleError, match=problem):
        check_answer(answer, ESP32_C6)
