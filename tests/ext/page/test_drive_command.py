"""``pebble drive`` in a real terminal, with a real broker and a robot that keeps control."""

from __future__ import annotations

import itertools
import signal
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from tests.commands.command_line import Run
from tests.kit.played_robot import RecordingRobot
from tests.kit.terminal import Terminal
from tests.support import Broker, some, until

NUMBERS = itertools.count(1)
BUSY_S = 0.35  # what a busy machine may add
ZERO, FINAL = {"x": 0, "z": 0, "y": 0}, {"x": 0, "z": 0, "y": 0, "valid_ms": 0}
Drive = Callable[..., Terminal]


@pytest.fixture
def lamp(broker: Broker) -> Iterator[RecordingRobot]:
    with RecordingRobot(broker.port, f"pebble/robots/lamp{next(NUMBERS)}", keeps=True) as one:
        yield one


@pytest.fixture
def url(broker: Broker) -> str:
    return f"mqtt://127.0.0.1:{broker.port}"


@pytest.fixture
def drive(lamp: RecordingRobot, url: str) -> Iterator[Drive]:
    consoles: list[Terminal] = []

    def start(*options: str) -> Terminal:
        consoles.append(Terminal(sys.executable, "-m", "pebble", "drive", lamp.id, "--url", url, *options))
        assert consoles[-1].sees("ready"), consoles[-1].shown
        return consoles[-1]

    yield start
    for console in consoles:
        console.close()


def sent(lamp: RecordingRobot) -> list[dict[str, Any]]:
    """Return the drive commands; those that move have a key."""
    commands = [dict(command) for command in lamp.drives()]
    assert all(command.pop("key", "") or not moves(command) for command in commands)
    return commands


def moves(command: dict[str, Any]) -> bool:
    return any(command[axis] for axis in "xyz")


def rests(lamp: RecordingRobot, within: float) -> bool:
    return until(lambda: not moves(lamp.drives()[-1]), within)


def driving(console: Terminal, lamp: RecordingRobot, key: bytes = b"w") -> None:
    """Press ``key``, and again where a stall of a busy machine has ended the gesture."""
    moving = lambda: moves((lamp.drives() or [ZERO])[-1]) and "driving x" in console.shown
    end = time.monotonic() + 20
    while not moving():
        assert time.monotonic() < end, console.shown
        console.hold(b"")
        time.sleep(0.5)
        console.forget()
        console.hold(key)
        until(moving, 2)


def test_a_held_key_drives_and_its_release_stops(drive: Drive, lamp: RecordingRobot) -> None:
    console = drive("--speed", "0.5")
    driving(console, lamp)
    time.sleep(1.0)
    console.hold(b"")
    assert rests(lamp, 0.4 + BUSY_S)
    assert console.sees("ready")
    assert until(lambda: sent(lamp)[-1] == ZERO)
    moved = [command for command in sent(lamp) if moves(command)]
    assert moved[0] == {"x": 0, "z": 0.5, "y": 0, "valid_ms": 400}
    assert 15 <= len(moved) <= 45
    assert lamp.keeping is not None
    owner = lamp.keeping.owners[0]
    assert owner.lease.holder[3].startswith("terminal_on_")
    console.type(b"\x03")
    assert console.process.wait(5) == 0
    assert console.restored
    assert until(lambda: owner.by == "")


def signalled(number: signal.Signals) -> Callable[[Terminal], None]:
    return lambda console: console.process.send_signal(number)


def typed(key: bytes) -> Callable[[Terminal], None]:
    def let_go_and_type(console: Terminal) -> None:
        console.hold(b"")
        console.type(key)

    return let_go_and_type


#: What ends a drive, and the exit status; None: the program goes on.
ENDS = {
    "SIGTERM": (signalled(signal.SIGTERM), 1),
    "SIGHUP": (signalled(signal.SIGHUP), 1),
    "Ctrl-D": (typed(b"\x04"), 0),
    "Ctrl-Z": (typed(b"w\x1a"), 0),
    "SIGQUIT": (signalled(signal.SIGQUIT), 1),
    "space": (typed(b" "), None),
    "SIGINT": (signalled(signal.SIGINT), 0),
}


@pytest.mark.parametrize("end", some(ENDS, 2))
def test_what_ends_a_drive_stops_the_robot_at_once(drive: Drive, lamp: RecordingRobot, end: str) -> None:
    console, (happens, code) = drive(), ENDS[end]
    driving(console, lamp, b"\x1b[D")
    assert lamp.drives()[-1]["x"] < 0, "an arrow turns"
    happens(console)
    assert rests(lamp, BUSY_S)
    assert until(lambda: console.process.poll() == code, 5)
    assert console.restored is (code is not None)
    assert until(lambda: sent(lamp)[-3:] == [FINAL] * 3), lamp.drives()[-8:]


@pytest.mark.parametrize("keys", some([b"\x1b\x1b", b"!"], 2))
def test_an_emergency_stop_latches(drive: Drive, lamp: RecordingRobot, run: Run, url: str, keys: bytes) -> None:
    console = drive()
    driving(console, lamp)
    console.type(keys)
    assert until(lambda: lamp.latched, BUSY_S)
    assert rests(lamp, BUSY_S)
    assert console.sees("Stopped by ")
    stopped = time.monotonic()
    time.sleep(1.0)
    assert not any(moves(command) for command in lamp.drives(stopped))
    assert console.process.poll() is None
    console.hold(b"")
    assert run("estop", "reset", lamp.id, "--url", url) == 0
    console.forget()
    assert console.sees("ready"), console.shown
    driving(console, lamp)


def test_an_emergency_stop_is_sent_on_after_the_terminal_has_ended(
    drive: Drive, lamp: RecordingRobot, run: Run, url: str
) -> None:
    console = drive()
    console.type(b"!\x04")
    assert console.process.wait(10) == 0
    assert lamp.latched
    assert "NOT CONFIRMED" not in console.shown.rpartition("\n")[2]
    assert run("estop", "reset", lamp.id, "--url", url) == 0, run.err


def test_without_a_terminal_there_is_one_line(run: Run) -> None:
    assert run("drive", "minilamp", "--url", "mqtt://127.0.0.1") == 1
    assert run.err.startswith("pebble: driving by keys needs a terminal of Linux or macOS: use `pebble web`, ")
    assert run.err.count("\n") == 1
