"""The small modules built into a simulated board: time, json, random, os, sys."""

from __future__ import annotations

import json

import pytest

from pebble.extensions.lab.simulation.micropython.board import Board
from pebble.extensions.lab.simulation.micropython.clock import RealClock, VirtualClock


def test_ticks_start_where_asked_and_wrap(clock: VirtualClock) -> None:
    time = Board(clock, ticks_at_boot_ms=(1 << 30) - 5).firmware.module("time")
    before = time.ticks_ms()
    clock.advance(0.57)
    assert (before, time.ticks_ms()) == ((1 << 30) - 5, 565)
    assert time.ticks_diff(time.ticks_ms(), before) == 570
    assert time.ticks_add(before, 570) == 565
    assert time.ticks_us() % 1000 == 0


def test_sleeping_passes_the_boards_time(board: Board, clock: VirtualClock) -> None:
    time = board.firmware.module("time")
    time.sleep(1)
    time.sleep_ms(20)
    time.sleep_us(500)
    assert clock.now() == pytest.approx(1001.0205)
    assert time.time() == 1
    assert time.ticks_ms() == 1020


def test_the_real_clock_is_real() -> None:
    clock = RealClock()
    before = clock.now()
    clock.sleep(0.01)
    clock.sleep(-1)
    assert clock.now() - before >= 0.01


@pytest.mark.parametrize(
    "text", ['{"x": NaN}', "Infinity", "-Infinity", "[" * 100_000, b"\xff\xfe1\x00", "", "{", "1 2"]
)
def test_json_takes_nothing_that_is_none(board: Board, text: str | bytes) -> None:
    with pytest.raises(ValueError):
        board.firmware.module("json").loads(text)


def test_json(board: Board) -> None:
    ours = board.firmware.module("json")
    assert ours.loads(b'{"x": [1, 2.5, "\xc3\xa4"]}') == {"x": [1, 2.5, "ä"]}
    assert json.loads(ours.dumps({"t": 5, "online": True})) == {"t": 5, "online": True}
    with pytest.raises(ValueError):
        ours.dumps(float("nan"))


def test_random_numbers_are_the_boards_own_and_repeat(clock: VirtualClock) -> None:
    def numbers(uid: bytes, seed: int | None = None) -> tuple[int, bytes]:
        firmware = Board(clock, uid=uid, seed=seed).firmware
        return firmware.module("random").getrandbits(30), firmware.module("os").urandom(8)

    assert numbers(b"a") == numbers(b"a") != numbers(b"b")
    assert numbers(b"a", 7) == numbers(b"b", 7)


def test_files(board: Board) -> None:
    board.files["/ca.der"] = b"\x30\x82"
    assert board.files.open("/ca.der", "rb").read() == b"\x30\x82"
    assert board.firmware.module("os").stat("/ca.der")[6] == 2
    assert board.firmware.module("os").listdir("/") == ["ca.der"]
    for action in (
        lambda: board.files.open("/none"),
        lambda: board.files.open("/ca.der", "r+"),
        lambda: board.firmware.module("os").stat("/none"),
    ):
        with pytest.raises(OSError):
            action()


def test_who_it_is(board: Board) -> None:
    assert board.firmware.module("machine").unique_id() == board.uid
    assert board.firmware.module("sys").platform == "esp32"
    assert board.firmware.module("sys").implementation.name == "micropython"
    assert board.firmware.module("machine").freq() == 160_000_000
    board.firmware.module("gc").collect()
    assert board.firmware.module("micropython").const(5) == 5
