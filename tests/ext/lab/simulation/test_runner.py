"""Firmware that runs, fails and hangs on a simulated board; and its own endless loop."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from pebble.extensions.lab.simulation.micropython.board import SETTINGS_FILE, Board
from pebble.extensions.lab.simulation.micropython.clock import VirtualClock
from pebble.extensions.lab.simulation.micropython.faults import FirmwareFault
from pebble.extensions.lab.simulation.micropython.loader import firmware_root
from pebble.extensions.lab.simulation.micropython.ports import ESP32_C6, ESP8266
from pebble.extensions.lab.simulation.micropython.runner import Runner
from pebble.extensions.lab.simulation.micropython.timers import BoardReset

ROBOT = """
import machine
import sys
import time

class Robot:
    def __init__(self, settings):
        self.settings = settings
        self.motor = machine.Pin(1, machine.Pin.OUT, value=0)

    def step(self):
        self.motor.on()
        what = self.settings.get("what")
        if what == "reset":
            machine.reset()
        elif what == "raise":
            raise ValueError("no good")
        elif what == "hang":
            sys.stdin.buffer.read(1)
        elif what == "sleep":
            time.sleep(10)

    def stop(self):
        self.motor.off()

def build(settings):
    return Robot(settings)
"""

MAIN = """
from common.run import run
from common.settings import load
from toy.robot import build

run(build, load())
"""


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A toy's firmware, with the real loop around it."""
    for folder in ("toy", "common"):
        (tmp_path / folder).mkdir()
    (tmp_path / "toy/robot.py").write_text(ROBOT)
    for name in ("common/run.py", "common/settings.py"):
        (tmp_path / name).write_text((firmware_root() / name).read_text())
    (tmp_path / "toy/main.py").write_text(MAIN)
    return tmp_path


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock()


def board(clock: VirtualClock, root: Path, port: Any = ESP32_C6) -> Board:
    return Board(clock, port=port, root=root)


def test_settings_reach_the_robot_and_its_file(clock: VirtualClock, root: Path) -> None:
    runner = Runner(board(clock, root), "toy", {"what": "drive"})
    runner.step()
    assert runner.board.duty(1) == 1.0
    assert runner.board.files[SETTINGS_FILE] == b'{"what": "drive"}'
    assert runner.board.resets == 0


@pytest.mark.parametrize("what", ["reset", "raise"])
def test_whatever_ends_the_program_stops_the_motors_and_starts_it_anew(
    clock: VirtualClock, root: Path, what: str, caplog: pytest.LogCaptureFixture
) -> None:
    booted: list[object] = []
    runner = Runner(board(clock, root), "toy", {"what": what}, on_boot=booted.append)
    for _ in range(2):
        runner.step()
    assert (runner.board.duty(1), runner.board.resets, len(booted)) == (0.0, 2, 3)
    assert ("ValueError: no good" in caplog.text) == (what == "raise")


def test_a_call_that_never_returns_is_shown_to_people(clock: VirtualClock, root: Path) -> None:
    with pytest.raises(FirmwareFault, match="waits for input"):
        Runner(board(clock, root), "toy", {"what": "hang"}).step()


class Enough(BaseException):
    """Ends the endless loop."""


def looped(clock: VirtualClock, root: Path, turns: int = 5, what: str = "drive", port: Any = ESP32_C6) -> Board:
    """A board that runs main.py; each turn of the loop takes a millisecond, and it ends after ``turns``."""
    toy = board(clock, root, port)

    def turned() -> None:
        clock.sleep(0.001)
        if toy.watchdog.feeds >= turns:
            raise Enough

    toy.watchdog.on_feed = turned
    toy.files[SETTINGS_FILE] = b'{"what": "%s"}' % what.encode()
    with pytest.raises((Enough, BoardReset)) as ended:
        toy.firmware.run("toy/main.py")
    assert (what == "drive") == (ended.type is Enough)
    assert {"drive": "", "raise": "machine.reset", "sleep": "watchdog"}[what] in str(ended.value)
    return toy


@pytest.mark.parametrize(("port", "timeout_ms"), [(ESP32_C6, 2000), (ESP8266, 5000)])
def test_the_real_loop_feeds_the_watchdog_each_turn(
    clock: VirtualClock, root: Path, port: Any, timeout_ms: int
) -> None:
    toy = looped(clock, root, 500, port=port)
    assert (toy.watchdog.timeout_ms, toy.watchdog.feeds, toy.duty(1)) == (timeout_ms, 500, 1.0)


def test_the_real_loop_resets_after_an_error_with_the_motors_off(clock: VirtualClock, root: Path) -> None:
    assert looped(clock, root, what="raise").duty(1) == 0.0


def test_the_watchdog_resets_firmware_that_hangs(clock: VirtualClock, root: Path) -> None:
    toy = looped(clock, root, what="sleep")
    assert toy.starved(clock.now())
    assert not toy.starved(clock.now() - 0.001), "it was reset at once"
    toy.boot()
    assert (toy.duty(1), toy.watchdog.timeout_ms) == (0.0, None)
