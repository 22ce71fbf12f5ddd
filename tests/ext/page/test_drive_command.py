"""``pebble drive`` in a real terminal, with a real broker and MiniLAMP's firmware on simulated motors."""

from __future__ import annotations

import json
import signal
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from pebble.transports import Message, MqttSettings, create
from tests.commands.command_line import Run
from tests.ext.page.stage import Stage
from tests.kit.terminal import Terminal
from tests.support import some, until

BASE = "pebble/robots/minilamp"
VALID_S = 0.4  # of a command
BUSY_S = 0.35  # what a busy machine may add
ZERO, FINAL = {"x": 0, "z": 0, "y": 0}, {"x": 0, "z": 0, "y": 0, "valid_ms": 0}


class Lamp:
    """MiniLAMP's own firmware on simulated motors: what these really do, and what reaches its broker."""

    def __init__(self, stage: Stage) -> None:
        self.commands: list[tuple[float, Any]] = []  # when they reached the broker
        self.control: dict[str, Any] = {}  # who has it
        self.stops = 0
        self._stage, self._since_ns = stage, 0
        self.url = f"mqtt://127.0.0.1:{stage.broker_port}"
        self._transport = create("mqtt", "observer", MqttSettings(host="127.0.0.1", port=stage.broker_port)).open()
        self._transport.subscribe(f"{BASE}/#", self._take)

    def close(self) -> None:
        self._transport.close()

    def forget(self) -> None:
        """Forget what was recorded, while the motors rest."""
        self.commands.clear()
        self.stops, self._since_ns = 0, time.monotonic_ns()

    @property
    def motors(self) -> list[tuple[float, tuple[float, float]]]:
        """When the motors changed, by the monotonic clock, and to what."""
        return [(ns / 1e9, speeds) for ns, speeds in self._stage.motors("minilamp") if ns > self._since_ns]

    @property
    def moving(self) -> bool:
        changes = self.motors
        return bool(changes) and changes[-1][1] != (0.0, 0.0)

    def halted_after(self, moment: float) -> float:
        """How long the motors went on after ``moment``."""
        assert until(lambda: not self.moving, 5), (moment, self.commands[-10:], self.motors[-5:])
        return self.motors[-1][0] - moment

    def moved_since(self, moment: float) -> bool:
        return any(at > moment and speeds != (0.0, 0.0) for at, speeds in self.motors)

    def _take(self, message: Message) -> None:
        metric = message.topic.rpartition("/")[2]
        if metric == "drive-values":
            command = json.loads(message.payload)
            assert command.pop("key", "") or not (command["x"] or command["z"] or command["y"])
            self.commands.append((time.monotonic(), command))
        elif "/outgoing/control/" in message.topic:
            self.control = json.loads(message.payload)
        elif message.topic.endswith("incoming/estop"):
            self.stops += 1


Drive = Callable[..., Terminal]


@pytest.fixture(scope="module")
def stage() -> Iterator[Stage]:
    with Stage("minilamp") as running:
        yield running


@pytest.fixture(scope="module")
def one_lamp(stage: Stage) -> Iterator[Lamp]:
    lamp = Lamp(stage)
    yield lamp
    lamp.close()


@pytest.fixture
def lamp(one_lamp: Lamp) -> Lamp:
    """It rests, and has recorded nothing yet."""
    assert until(lambda: not one_lamp.moving, 5)
    one_lamp.forget()
    return one_lamp


@pytest.fixture
def drive(lamp: Lamp) -> Iterator[Drive]:
    consoles: list[Terminal] = []

    def start(*options: str, shows: str = "ready") -> Terminal:
        consoles.append(Terminal(sys.executable, "-m", "pebble", "drive", "minilamp", "--url", lamp.url, *options))
        assert consoles[-1].sees(shows), consoles[-1].shown
        return consoles[-1]

    yield start
    for console in consoles:
        console.close()


def driving(console: Terminal, lamp: Lamp, key: bytes = b"w") -> None:
    """Press ``key``, and again where a stall of a busy machine has ended the gesture."""
    end = time.monotonic() + 20
    while not (lamp.moving and "driving x" in console.shown):
        assert time.monotonic() < end, console.shown
        console.hold(b"")
        time.sleep(0.5)
        console.forget()
        console.hold(key)
        until(lambda: lamp.moving and "driving x" in console.shown, 2)


def test_a_held_key_drives_and_its_release_stops(drive: Drive, lamp: Lamp) -> None:
    console = drive("--speed", "0.5")
    before = time.monotonic()
    driving(console, lamp)
    time.sleep(1.0)
    console.hold(b"")
    assert lamp.halted_after(time.monotonic()) < 0.4 + BUSY_S
    assert console.sees("ready")
    sent = [command for at, command in lamp.commands if at > before]
    assert sent[0] == {"x": 0, "z": 0.5, "y": 0, "valid_ms": 400}
    assert until(lambda: lamp.commands[-1][1] == ZERO)
    assert 15 <= len([command for command in sent if command["z"]]) <= 45
    assert lamp.control["device"].startswith("terminal_on_")
    console.type(b"\x03")
    assert console.process.wait(5) == 0
    assert console.restored
    assert until(lambda: lamp.control["key"] == "")


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
def test_what_ends_a_drive_stops_the_robot_at_once(drive: Drive, lamp: Lamp, end: str) -> None:
    console, (happens, code) = drive(), ENDS[end]
    driving(console, lamp, b"\x1b[D")
    assert lamp.motors[-1][1][0] < lamp.motors[-1][1][1], "an arrow turns"
    happens(console)
    assert lamp.halted_after(time.monotonic()) < BUSY_S
    assert until(lambda: console.process.poll() == code, 5)
    assert console.restored is (code is not None)
    assert until(lambda: [command for _, command in lamp.commands[-3:]] == [FINAL] * 3), lamp.commands[-8:]


@pytest.mark.parametrize("stall", some([2.0, 0.6], 2))
def test_after_a_stall_a_key_that_is_still_held_moves_nothing(drive: Drive, lamp: Lamp, stall: float) -> None:
    console = drive()
    driving(console, lamp)
    console.process.send_signal(signal.SIGSTOP)
    stopped = time.monotonic()
    assert lamp.halted_after(stopped) < VALID_S + BUSY_S
    time.sleep(max(0.0, stopped + stall - time.monotonic()))
    console.forget()
    resumed = time.monotonic()
    console.process.send_signal(signal.SIGCONT)
    assert console.sees("let go first")
    time.sleep(1.0)
    assert not lamp.moved_since(resumed)
    console.hold(b"")
    assert console.sees("ready")
    driving(console, lamp)


@pytest.mark.parametrize("keys", some([b"\x1b\x1b", b"!"], 2))
def test_an_emergency_stop_latches(drive: Drive, lamp: Lamp, run: Run, keys: bytes) -> None:
    console = drive()
    driving(console, lamp)
    console.type(keys)
    pressed = time.monotonic()
    assert lamp.halted_after(pressed) < BUSY_S
    assert console.sees("Stopped by ")
    time.sleep(1.0)
    assert (lamp.moved_since(pressed + BUSY_S), console.process.poll()) == (False, None)
    console.hold(b"")
    assert run("estop", "reset", "minilamp", "--url", lamp.url) == 0
    console.forget()
    assert console.sees("ready"), console.shown
    driving(console, lamp)


def test_an_emergency_stop_is_sent_on_after_the_terminal_has_ended(drive: Drive, lamp: Lamp, run: Run) -> None:
    console = drive()
    console.type(b"!\x04")
    assert console.process.wait(10) == 0
    assert lamp.stops >= 1
    assert "NOT CONFIRMED" not in console.shown.rpartition("\n")[2]
    assert run("estop", "reset", "minilamp", "--url", lamp.url) == 0, run.err


def test_a_broker_that_is_gone_and_comes_back(drive: Drive, lamp: Lamp, stage: Stage) -> None:
    console = drive()
    driving(console, lamp)
    console.forget()
    stage.remote_broker.kill()
    assert console.sees("no connection: ")
    assert lamp.halted_after(time.monotonic()) < VALID_S + 1.0
    console.hold(b"")
    stage.restart_broker()
    console.forget()
    assert console.sees("ready", 30)
    driving(console, lamp)


def test_without_a_terminal_there_is_one_line(run: Run) -> None:
    assert run("drive", "minilamp", "--url", "mqtt://127.0.0.1") == 1
    assert run.err.startswith("pebble: driving by keys needs a terminal of Linux or macOS: use `pebble web`, ")
    assert run.err.count("\n") == 1
