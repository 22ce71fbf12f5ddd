"""``pebble drive``: in a real terminal at a robot that keeps control, and its driver in virtual time."""

from __future__ import annotations

import itertools
import json
import signal
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from pebble.extensions.page.commands.terminal_driver import TerminalDriver
from pebble.transports import Message
from tests.commands.command_line import Run
from tests.ext.operator.client.estop_robot import KeepingRobot, Robot, outgoing
from tests.kit.played_robot import RecordingRobot
from tests.kit.terminal import Terminal
from tests.support import SOON_S, WAIT_S, Broker, until

NUMBERS = itertools.count(1)
ZERO, FINAL = {"x": 0, "z": 0, "y": 0}, {"x": 0, "z": 0, "y": 0, "valid_ms": 0}
Drive = Callable[..., Terminal]


@pytest.fixture
def lamp(broker: Broker, request: pytest.FixtureRequest) -> Iterator[RecordingRobot]:
    named = getattr(request, "param", False)
    with RecordingRobot(broker.port, f"pebble/robots/lamp{next(NUMBERS)}", keeps=True, named=named) as one:
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


def rests(lamp: RecordingRobot) -> bool:
    return until(lambda: not moves(lamp.drives()[-1]), SOON_S)


def driving(console: Terminal, lamp: RecordingRobot, key: bytes = b"w") -> None:
    """Press ``key``, and again where a stall of a busy machine has ended the gesture."""
    moving = lambda: moves((lamp.drives() or [ZERO])[-1]) and "driving x" in console.shown
    end = time.monotonic() + WAIT_S
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
    assert until(lambda: sum(map(moves, lamp.drives())) >= 15)
    console.hold(b"")
    assert rests(lamp)
    assert console.sees("ready")
    assert until(lambda: sent(lamp)[-1] == ZERO)
    moved = [command for command in sent(lamp) if moves(command)]
    assert moved[0] == {"x": 0, "z": 0.5, "y": 0, "valid_ms": 400}
    assert len(moved) <= 45
    assert lamp.keeping is not None
    owner = lamp.keeping.owners[0]
    assert owner.lease.holder[3].startswith("terminal_on_")
    console.type(b"\x03")
    assert console.process.wait(WAIT_S) == 0
    assert console.restored
    assert until(lambda: owner.by == "")


@pytest.mark.parametrize("lamp", [True], ids=["named"], indirect=True)
def test_a_robot_that_wants_names_gets_them(drive: Drive, lamp: RecordingRobot, url: str) -> None:
    driving(drive("--url", url.replace("//", "//ann@")), lamp)
    assert f"{lamp.base}/incoming/by/ann/drive-values" in lamp.wire


#: What ends a drive, and the exit status; None: the program goes on.
ENDS: dict[str, tuple[Callable[[Terminal], object], int | None]] = {
    "SIGTERM": (lambda console: console.process.send_signal(signal.SIGTERM), 0),
    "SIGQUIT": (lambda console: console.process.send_signal(signal.SIGQUIT), 1),
    "Ctrl-D": (lambda console: (console.hold(b""), console.type(b"\x04")), 0),
    "space": (lambda console: (console.hold(b""), console.type(b" ")), None),
}


@pytest.mark.parametrize("end", ENDS)
def test_what_ends_a_drive_stops_the_robot_at_once(drive: Drive, lamp: RecordingRobot, end: str) -> None:
    console, (happens, code) = drive(), ENDS[end]
    driving(console, lamp, b"\x1b[D")
    assert lamp.drives()[-1]["x"] < 0, "an arrow turns"
    happens(console)
    assert rests(lamp)
    assert until(lambda: console.process.poll() == code)
    assert console.restored is (code is not None)
    assert until(lambda: sent(lamp)[-3:] == [FINAL] * 3), lamp.drives()[-8:]


def test_an_emergency_stop_latches(drive: Drive, lamp: RecordingRobot, run: Run, url: str) -> None:
    console = drive()
    driving(console, lamp)
    console.type(b"\x1b\x1b")
    assert until(lambda: lamp.latched, SOON_S)
    assert rests(lamp)
    assert console.sees("Stopped by ")
    stopped = time.monotonic()
    time.sleep(1.0)
    assert not any(moves(command) for command in lamp.drives(stopped))
    console.hold(b"")
    assert run("estop", "reset", lamp.id, "--url", url) == 0
    console.forget()
    assert console.sees("ready"), console.shown
    driving(console, lamp)


@pytest.mark.parametrize("deaf", [False, True])
def test_an_emergency_stop_is_sent_on_after_the_terminal_has_ended(
    drive: Drive, lamp: RecordingRobot, deaf: bool
) -> None:
    console = drive()
    lamp.deaf = deaf
    console.type(b"!\x04")
    assert console.process.wait(WAIT_S) == int(deaf)
    assert lamp.latched is not deaf
    assert console.sees(f"the emergency stop of {lamp.id} is NOT CONFIRMED", 1) is deaf


#: A key, and True if the robot has what it sends.
STANDING: dict[str, tuple[bytes, Callable[[RecordingRobot], bool]]] = {
    "space": (b" ", lambda lamp: FINAL in lamp.drives()),
    "emergency stop": (b"!", lambda lamp: lamp.latched),
}


@pytest.mark.parametrize(("key", "arrives"), STANDING.values(), ids=STANDING)
def test_a_terminal_that_stands_still_delays_nothing_and_is_restored(
    drive: Drive, lamp: RecordingRobot, key: bytes, arrives: Callable[[RecordingRobot], bool]
) -> None:
    console = drive()
    with console.standing_still():
        time.sleep(0.3)
        console.type(b"\x1b[C")  # it has something new to show
        assert until(lambda: any(map(moves, lamp.drives())), SOON_S)
        console.type(key)
        assert until(lambda: arrives(lamp), 0.5)
        console.type(b"\x04")
        assert until(lambda: console.restored)
    assert console.ends() == 0


def test_without_a_terminal_there_is_one_line(run: Run) -> None:
    assert run("drive", "minilamp", "--url", "mqtt://127.0.0.1") == 1
    assert run.err.startswith("pebble: driving by keys needs a terminal of Linux or macOS: use `pebble web`, ")
    assert run.err.count("\n") == 1


# -- the driver alone


GOOB = "pebble/robots/goob"
DRIVE, ESTOP = f"{GOOB}/incoming/drive-values", f"{GOOB}/incoming/estop"
WALL = 1_760_000_000.0
TICK = 0.05


class Cab:
    """A driver at a terminal, and the robot, in virtual time."""

    def __init__(self, *, heartbeat: bool = True, assume: bool = False, **more: Any) -> None:
        self.robot = Robot(GOOB, "serial", **more)
        self.driver = TerminalDriver(
            GOOB, by="ann@desk", device="terminal", speed=0.6, turn=0.8, heartbeat=heartbeat, assume=assume
        )
        self.now, self.heartbeats = 0.0, heartbeat
        self.problem = ""
        self.sent: list[Message] = []

    def receive(self, *messages: Message) -> None:
        for message in messages:
            self.driver.receive(message, self.now, WALL + self.now)

    def run(self, seconds: float, key: str = "") -> list[Any]:
        """Let time pass while ``key`` is held; return the drive commands."""
        start = len(self.sent)
        for tick in range(round(seconds / TICK)):
            if self.heartbeats and tick % 5 == 0:
                self.receive(outgoing(GOOB, "online", {"t": int(1000 * (WALL + self.now))}))
            self.driver.press([key] if key else [], self.now)
            self.sent += self.driver.tick(self.now, self.problem)
            self.now = round(self.now + TICK, 6)
        return [json.loads(message.payload) for message in self.sent[start:] if message.topic == DRIVE]

    def moves(self, key: str = "w") -> bool:
        """True if ``key``, pressed anew, moves the robot."""
        self.run(0.5)
        return any(drive["x"] or drive["z"] for drive in self.run(0.5, key))

    def ready(self) -> Cab:
        self.receive(self.robot.capabilities(), *(owner.state() for owner in self.robot.owners))
        self.run(2.0)
        assert self.driver.status().startswith("goob · ready")
        return self


@pytest.mark.parametrize(("key", "x", "z"), [("w", 0, 0.6), ("down", 0, -0.6), ("d", 0.8, 0), ("left", -0.8, 0)])
def test_a_held_key_drives_until_04_s_after_its_last_repetition(key: str, x: float, z: float) -> None:
    cab = Cab().ready()
    commands = cab.run(1.0, key)
    assert {(command["x"], command["z"], command["valid_ms"]) for command in commands} == {(x, z, 400)}
    assert 15 <= len(commands) <= 20
    after = cab.run(1.0)
    moving = [command for command in after if command["x"] or command["z"]]
    assert 6 <= len(moving) <= 8
    assert after[len(moving) :] == [{"x": 0, "z": 0, "y": 0}]


def test_a_board_that_never_says_what_it_can_do_is_driven_if_a_person_says_that_it_drives() -> None:
    assert not Cab().moves()
    cab = Cab(assume=True)
    assert cab.run(4.0, "w") == []
    cab.run(2.0)
    assert cab.run(0.2, "w")[-1] == {"x": 0.0, "z": 0.6, "y": 0.0}
    assert cab.run(2.0)[-3:] == [{"x": 0.0, "z": 0.0, "y": 0.0}] * 3
    cab.receive(Message(DRIVE, b'{"z": 1}', retain=True))
    assert not cab.moves()
    assert "retained on its topic" in cab.driver.status()


def test_no_wheel_is_faster_than_1() -> None:
    cab = Cab().ready()
    cab.driver.press(["w", "d"], cab.now)
    command = cab.run(0.1)[0]
    assert command["x"] + command["z"] == pytest.approx(1.0, abs=0.002)


#: What speaks against driving, and what the status says.
REASONS = [
    ("problem", "no connection: it was lost"),
    ("silent", "goob is silent"),
    ("stopped", "Emergency stop"),
]


@pytest.mark.parametrize(("event", "words"), REASONS)
def test_a_reason_ends_the_drive_and_the_keys_must_be_released(event: str, words: str) -> None:
    cab = Cab().ready()
    assert cab.run(0.5, "w")[-1]["z"] == 0.6
    before, heartbeats = len(cab.sent), cab.heartbeats
    cab.problem = "it was lost" if event == "problem" else ""
    cab.heartbeats = event != "silent"
    cab.driver.press(["!"] if event == "stopped" else [], cab.now)
    commands = cab.run(3.0, "w")
    assert words in cab.driver.status()
    assert commands[-3:] == [{"x": 0, "z": 0, "y": 0, "valid_ms": 0}] * 3
    assert any(message.topic == ESTOP for message in cab.sent[before:]) is (event == "stopped")
    cab.problem, cab.heartbeats = "", heartbeats
    cab.receive(*(owner.state() for owner in cab.robot.owners))
    assert [command for command in cab.run(2.0, "w") if command["z"]] == []
    assert cab.moves() is (event != "stopped")


BOARD = "serial: no board"
#: What the robot's status says of its motors, and the status line at rest, with a key held, and after the stop.
MOTORS = {
    "no": ("Cannot be driven: B", "Cannot be driven: B", "Stopped by me · nothing confirms that its motors stand: B"),
    "unknown": (
        "ready · Not known whether it can be driven: B",
        "driving x +0.00 z +0.60 · Not known whether it can be driven: B",
        "Stopped by me · it is not known whether its motors stand: B",
    ),
    "yes": ("ready", "driving x +0.00 z +0.60", "Stopped by me"),
}


@pytest.mark.parametrize("state", MOTORS)
def test_the_status_says_whether_commands_reach_the_motors_and_a_stop_is_sent_all_the_same(state: str) -> None:
    cab = Cab().ready()
    cab.receive(outgoing(GOOB, "status", {"value": {"driveable": {"state": state, "why": BOARD}}}))
    shown = [cab.driver.status()]
    cab.run(0.5, "w")
    shown.append(cab.driver.status())
    cab.driver.press(["!"], cab.now)
    cab.run(0.1)
    cab.receive(*cab.robot.take([message for message in cab.sent if message.topic == ESTOP][:1]))
    cab.run(1.0)
    assert cab.robot.owners[0].latch.latched
    shown.append(cab.driver.status().replace("ann@desk", "me"))
    assert shown == [f"goob · {line}".replace(": B", f": {BOARD}") for line in MOTORS[state]]


def test_keys_that_were_held_back_on_the_way_move_nothing() -> None:
    cab = Cab().ready()
    cab.driver.press(["w"] * 8, cab.now)
    assert [command for command in cab.run(1.0) if command["z"]] == []
    assert cab.moves()


def test_a_process_that_stood_still_needs_a_new_key() -> None:
    cab = Cab().ready()
    cab.run(0.5, "w")
    cab.now += 0.6
    assert [command for command in cab.run(1.0, "w") if command["z"]] == []
    assert "let go first" in cab.driver.status()
    assert cab.moves()


def test_the_status_names_a_layout_without_latin_letters_and_a_script_that_drives() -> None:
    cab = Cab().ready()
    cab.run(0.1, "ц")
    assert "this keyboard types ц: W A S D need a Latin layout" in cab.driver.status()
    assert cab.moves("up")
    cab.receive(outgoing(GOOB, "autonomy-status", {"running": True, "timestamp": 1, "file": "x", "label": "Follow"}))
    assert cab.driver.status().startswith("goob · goob drives itself: Follow · ")


#: What becomes of a request for control that bob has: his robot's state after it, the seconds, the status line.
ASKED: dict[str, tuple[dict[str, Any], float, str]] = {
    "it waits": ({"asks": "ann", "asks_id": "{id}"}, 0.5, "asked bob for control · "),
    "he gives it": ({"by": "ann", "id": "{id}", "key": "k2"}, 0.5, "you have control, no longer bob · ready"),
    "he drives on": ({"asks": "ann", "asks_id": "{id}"}, 31, "bob drives on · "),
    "no answer": ({}, 31, "goob does not answer · "),
}


@pytest.mark.parametrize(("state", "seconds", "words"), ASKED.values(), ids=ASKED)
def test_who_asks_for_control_sees_that_it_is_asked_for_and_what_came_of_it(
    state: dict[str, str], seconds: float, words: str
) -> None:
    cab = Cab()
    cab.robot.value["drive"]["control"] = True
    held = {"by": "bob", "id": "b0b", "key": "k1"}
    cab.receive(cab.robot.capabilities(), *(owner.state() for owner in cab.robot.owners))
    cab.receive(outgoing(GOOB, "control/serial", held))
    cab.run(2.0)
    cab.run(0.1, "t")
    id_ = next(json.loads(message.payload)["id"] for message in cab.sent if message.topic == f"{GOOB}/incoming/control")
    cab.receive(outgoing(GOOB, "control/serial", held | {key: text.format(id=id_) for key, text in state.items()}))
    cab.run(seconds)
    assert cab.driver.status().startswith(f"goob · {words}")


def test_who_leaves_sends_a_last_zero_and_nothing_more_than_twice_after_it() -> None:
    cab = Cab().ready()
    cab.run(0.5, "w")
    cab.driver.end(cab.now, leave=True)
    assert cab.run(1.0) == [{"x": 0, "z": 0, "y": 0, "valid_ms": 0}] * 3


def test_a_request_for_control_that_is_not_answered_is_named() -> None:
    cab = Cab()
    cab.robot.value["drive"] |= {"control": True}
    cab.receive(cab.robot.capabilities(), *(owner.state() for owner in cab.robot.owners), *KeepingRobot(GOOB).states())
    cab.run(6.0)
    assert " · goob does not answer" in cab.driver.status()
