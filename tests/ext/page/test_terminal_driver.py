"""Driving from a terminal: what is sent, and what is shown."""

from __future__ import annotations

import json
from typing import Any

import pytest

from pebble.extensions.page.commands.terminal_driver import TerminalDriver
from pebble.transports import Message
from tests.ext.operator.client.estop_robot import Robot, outgoing

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


@pytest.mark.parametrize(
    ("key", "x", "z"),
    [("w", 0, 0.6), ("down", 0, -0.6), ("d", 0.8, 0), ("left", -0.8, 0)],
)
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
    (command, *_) = cab.run(0.1)
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


def test_a_layout_without_latin_letters_is_named() -> None:
    cab = Cab().ready()
    cab.run(0.1, "ц")
    assert "this keyboard types ц: W A S D need a Latin layout" in cab.driver.status()
    assert cab.moves("up")


def test_a_robot_that_drives_itself_is_said_to() -> None:
    cab = Cab().ready()
    cab.receive(
        outgoing(GOOB, "autonomy-status", {"running": True, "timestamp": 1, "file": "x", "label": "Follow a tag"})
    )
    assert cab.driver.status().startswith("goob · goob drives itself: Follow a tag · ")


def test_who_leaves_sends_a_last_zero_and_nothing_more_than_twice_after_it() -> None:
    cab = Cab().ready()
    cab.run(0.5, "w")
    cab.driver.end(cab.now, leave=True)
    assert cab.run(1.0) == [{"x": 0, "z": 0, "y": 0, "valid_ms": 0}] * 3
