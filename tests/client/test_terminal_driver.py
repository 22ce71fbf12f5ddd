"""Driving from a terminal: what is sent, why nothing is, and what is shown."""

from __future__ import annotations

import json
from typing import Any

import pytest

from pebble.client.driver_lease import DriverLease
from pebble.client.terminal.driver import TerminalDriver
from pebble.client.terminal.key_gesture import KeyGesture
from pebble.transports import Message
from tests.client.estop_robot import Robot, outgoing

GOOB = "pebble/robots/goob"
DRIVE, ESTOP, DRIVING = f"{GOOB}/incoming/drive-values", f"{GOOB}/incoming/estop", "pebble/servers/me/outgoing/driving"
WALL = 1_760_000_000.0
TICK = 0.05


class Cab:
    """A driver at a terminal, and the robot."""

    def __init__(self, *, take_over: bool = False, heartbeat: bool = True, **more: Any) -> None:
        self.robot = Robot(GOOB, "serial", **more)
        lease = DriverLease(GOOB, "me", by="ann@desk", device="terminal on desk")
        self.driver = TerminalDriver(
            GOOB, KeyGesture(0.6, 0.8), lease, by="ann@desk", now=0.0, take_over=take_over, heartbeat=heartbeat
        )
        self.now = 0.0
        self.heartbeats = heartbeat
        self.problem, self.late_s = "", 0.0
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
            if key:
                self.driver.press([key], self.now)
            wall = WALL + self.now
            self.sent += self.driver.tick(self.now, wall, problem=self.problem, late_s=self.late_s)
            self.now = round(self.now + TICK, 6)
        return [json.loads(message.payload) for message in self.sent[start:] if message.topic == DRIVE]

    def moves(self, seconds: float = 0.5, key: str = "w") -> bool:
        """Whether ``key``, pressed anew, moves the robot."""
        self.run(0.5)
        return any(drive["x"] or drive["z"] for drive in self.run(seconds, key))

    def ready(self) -> Cab:
        self.receive(self.robot.capabilities(), *(owner.state() for owner in self.robot.owners))
        self.run(2.0)
        return self

    @property
    def status(self) -> str:
        return self.driver.status()

    def announced(self) -> list[Any]:
        return [json.loads(message.payload)["robots"] for message in self.sent if message.topic == DRIVING]


def announcement(since: float, server: str = "fair-1") -> Message:
    robots = {GOOB: {"by": "bob", "device": "phone", "since": int(1000 * since)}}
    return Message(f"pebble/servers/{server}/outgoing/driving", json.dumps({"t": 1, "robots": robots}).encode())


def test_a_key_drives_and_announces_who_does() -> None:
    cab = Cab().ready()
    assert cab.status.startswith("goob · ready")
    assert cab.announced() == []
    first, *_ = cab.run(1.0, "w")
    assert first == {"x": 0, "z": 0.6, "y": 0, "valid_ms": 400}
    assert cab.status.startswith("goob · driving x +0.00 z +0.60")
    assert len(cab.announced()) == 1
    assert cab.announced()[0][GOOB]["by"] == "ann@desk"


def test_what_is_known_of_the_robot_is_shown() -> None:
    cab = Cab().ready()
    cab.receive(outgoing(GOOB, "charging-level", {"value": 12.14, "unit": "v"}))
    cab.run(0.5, "w")
    announced = next(message for message in cab.sent if message.topic == DRIVING)
    cab.receive(announced)
    assert cab.status.endswith(" · 12.1 V · 500 ms")


@pytest.mark.parametrize("key", ["w", "a", "q"])
def test_nothing_is_driven_before_anything_is_known(key: str) -> None:
    cab = Cab(heartbeat=False)
    assert cab.run(3.0, key) == []
    assert "goob has not published what it can do" in cab.status


def test_at_first_others_are_listened_for() -> None:
    cab = Cab(heartbeat=False)
    cab.receive(cab.robot.capabilities())
    assert cab.run(1.0, "w") == []
    assert "listening for other drivers" in cab.status


def test_without_a_connection_nothing_is_sent() -> None:
    cab = Cab().ready()
    cab.run(0.5, "w")
    cab.problem = "Connection refused"
    assert [drive for drive in cab.run(0.3, "w") if drive["z"]] == []
    assert "no connection: Connection refused" in cab.status
    cab.problem = ""
    assert [drive for drive in cab.run(1.0, "w") if drive["z"]] == [], "the key was held all the time"
    assert "let go first" in cab.status
    assert cab.moves()


@pytest.mark.parametrize(
    ("message", "shown"),
    [
        (outgoing(GOOB, "online", {"t": int(1000 * WALL), "online": False}), "goob is offline"),
        (Message(f"{GOOB}/outgoing/capabilities", b'{"t": 1, "value": {}}', retain=True), "goob does not drive"),
        (
            Message(
                f"{GOOB}/outgoing/capabilities", b'{"t": 1, "value": {"drive": {"available": false}}}', retain=True
            ),
            "goob does not drive",
        ),
        (announcement(WALL), "bob (phone) at fair-1 is driving (--take-over drives instead)"),
    ],
)
def test_reasons_against_driving(message: Message, shown: str) -> None:
    cab = Cab().ready()
    cab.heartbeats = False
    cab.receive(message)
    assert cab.run(0.5, "w") == []
    assert shown in cab.status


def test_a_silent_robot_is_not_driven() -> None:
    cab = Cab().ready()
    cab.heartbeats = False
    assert cab.moves(1.0)
    assert not cab.moves(1.0)
    assert "goob is silent for 3 s" in cab.status


def test_a_stopped_robot_is_not_driven_and_the_stopper_is_named() -> None:
    cab = Cab().ready()
    cab.run(0.5, "w")
    cab.robot.owners[0].latch.stop("0123456789abcdef", "eve@fair", "dog", 1)
    cab.receive(cab.robot.owners[0].state())
    assert cab.run(0.5, "w") == [{"x": 0, "z": 0, "y": 0, "valid_ms": 0}] * 3
    assert "stopped by eve@fair (dog): pebble estop reset goob" in cab.status


def test_a_script_is_overruled_only_where_the_robot_arbitrates() -> None:
    running = outgoing(GOOB, "autonomy-status", {"running": True, "timestamp": 1.0, "file": "follow"})
    cab = Cab().ready()
    cab.receive(running)
    assert cab.moves()
    cab = Cab(drive={"available": True, "topic": DRIVE}).ready()
    cab.receive(running)
    assert not cab.moves()
    assert "follow is driving: stop it first" in cab.status


def test_late_commands_are_not_sent() -> None:
    cab = Cab().ready()
    cab.run(0.5, "w")
    cab.late_s = 0.7
    assert [drive for drive in cab.run(0.2, "w") if drive["z"]] == []
    assert "commands are late (700 ms)" in cab.status
    cab.late_s = 0.0
    assert cab.moves()


def test_an_announcement_that_does_not_come_back_means_that_commands_are_late() -> None:
    cab = Cab().ready()
    cab.run(0.2, "w")
    cab.receive(next(message for message in cab.sent if message.topic == DRIVING))
    assert cab.moves(0.5)
    assert not cab.moves(1.0)
    assert "commands are late" in cab.status


def test_a_slow_connection_drives_slowly() -> None:
    cab = Cab().ready()
    cab.run(0.4, "w")
    cab.receive(next(message for message in cab.sent if message.topic == DRIVING))
    assert cab.run(0.1, "w")[-1]["z"] == 0.4


def test_space_stops_at_once_and_ends_the_gesture() -> None:
    cab = Cab().ready()
    cab.run(0.5, "w")
    cab.driver.press(["space"], cab.now)
    assert cab.run(0.5, "w") == [{"x": 0, "z": 0, "y": 0, "valid_ms": 0}] * 3


def test_space_stops_also_where_nothing_may_be_driven() -> None:
    cab = Cab(heartbeat=False)
    cab.driver.press(["space"], cab.now)
    assert cab.run(0.05) == [{"x": 0, "z": 0, "y": 0, "valid_ms": 0}]


# -- the emergency stop


@pytest.mark.parametrize("keys", [["!"], ["escape", "escape"]])
def test_an_emergency_stop_is_sent_until_it_is_confirmed(keys: list[str]) -> None:
    cab = Cab().ready()
    cab.run(0.5, "w")
    before = len(cab.sent)
    cab.driver.press(keys, cab.now)
    cab.run(1.2, "w")
    stops = [message for message in cab.sent[before:] if message.topic == ESTOP]
    assert len(stops) == 3
    assert len({message.payload for message in stops}) == 1
    assert cab.sent[before].topic == ESTOP
    assert json.loads(stops[0].payload)["by"] == "ann@desk"
    assert "EMERGENCY STOP sent, NOT CONFIRMED: serial has not confirmed" in cab.status
    assert cab.driver.unconfirmed
    cab.receive(*cab.robot.take(stops[:1]))
    cab.run(1.0, "w")
    assert len([message for message in cab.sent[before:] if message.topic == ESTOP]) == 3
    assert (cab.driver.unconfirmed, "stopped by ann@desk" in cab.status) == (False, True)


def test_invented_owners_keep_no_capabilities_from_a_later_stop() -> None:
    cab = Cab()
    cab.receive(*(outgoing(GOOB, f"estop/fake{number}", {}) for number in range(100)))
    cab.ready()
    cab.driver.press(["escape", "escape"], cab.now)
    assert cab.driver.stop.newest is not None
    assert cab.driver.stop.newest.robots[GOOB].estop.has_capabilities


def test_escape_once_is_no_emergency_stop() -> None:
    cab = Cab().ready()
    cab.driver.press(["escape"], cab.now)
    cab.run(0.7)
    cab.driver.press(["escape"], cab.now)
    cab.run(0.7)
    assert [message for message in cab.sent if message.topic == ESTOP] == []


def test_a_robot_that_was_reset_is_driven_again() -> None:
    cab = Cab().ready()
    cab.driver.press(["!"], cab.now)
    cab.run(0.1)
    cab.receive(*cab.robot.take([message for message in cab.sent if message.topic == ESTOP]))
    assert not cab.moves()
    reset = json.dumps({"boot": "00000000", "count": 1}).encode()
    cab.receive(*cab.robot.take([Message(f"{GOOB}/incoming/estop-reset", reset)]))
    assert cab.run(0.5, "w") == []
    assert "it was reset a moment ago" in cab.status
    cab.run(0.2)
    assert cab.moves()
    cab.driver.press(["!"], cab.now)
    cab.run(0.1)
    names = {message.payload for message in cab.sent if message.topic == ESTOP}
    assert len(names) == 2


# -- other drivers


def test_another_driver_is_taken_over_on_demand_only() -> None:
    cab = Cab(take_over=True).ready()
    cab.receive(announcement(WALL))
    assert cab.moves()
    assert cab.announced()[0][GOOB]["since"] > 1000 * WALL


def test_who_is_taken_over_stops_and_does_not_take_it_back() -> None:
    cab = Cab(take_over=True).ready()
    cab.run(0.5, "w")
    start = len(cab.sent)
    cab.receive(announcement(WALL + 60))
    assert cab.run(0.5, "w") == [{"x": 0, "z": 0, "y": 0, "valid_ms": 0}]
    assert {} in [json.loads(m.payload)["robots"] for m in cab.sent[start:] if m.topic == DRIVING]
    cab.receive(announcement(WALL + 60))
    assert not cab.moves()
    assert "bob (phone) at fair-1 is driving" in cab.status
    cab.run(3.0)
    assert cab.moves(), "the other driver is gone"


# -- the end


def test_the_end_stops_the_robot_and_gives_it_back() -> None:
    cab = Cab().ready()
    cab.run(0.5, "w")
    drive, announced = cab.driver.leave(cab.now, WALL + cab.now)
    assert json.loads(drive.payload)["valid_ms"] == 0
    assert json.loads(announced.payload)["robots"] == {}
    assert cab.run(0.2) == [{"x": 0, "z": 0, "y": 0, "valid_ms": 0}] * 2


def test_a_command_that_the_transport_refuses_ends_the_gesture() -> None:
    cab = Cab().ready()
    cab.run(0.5, "w")
    cab.driver.refused(cab.now)
    assert cab.run(0.5, "w") == []


@pytest.mark.parametrize(("level", "hz", "qos", "valid_ms"), [("narrow", 10, 0, 400), ("thin", 4, 0, 750)])
def test_over_a_thin_link_it_sends_less_and_stops_as_ever(level: str, hz: int, qos: int, valid_ms: int) -> None:
    cab = Cab().ready()
    cab.receive(outgoing(GOOB, "link", {"level": level, "drive_hz": hz, "rtt_ms": 280, "queue_ms": 0, "t": 1}))
    *moves, zero, _, _ = cab.run(2.0, "w") + cab.run(1.0)
    assert cab.status.endswith("slow connection: commands take 0.1 s")
    assert [one["t"] for one in moves] == [2000 + 1000 * n // hz for n in range(len(moves))]
    assert len(moves) >= 2.3 * hz
    assert (len({one["key"] for one in moves}), {one["valid_ms"] for one in moves}) == (1, {valid_ms})
    assert zero == {"x": 0, "z": 0, "y": 0}
    assert [one.qos for one in cab.sent if one.topic == DRIVE] == [qos] * len(moves) + [1] * 3


def test_within_the_robot_there_is_no_link() -> None:
    cab = Cab(heartbeat=False).ready()
    cab.receive(outgoing(GOOB, "link", {"level": "thin", "drive_hz": 4, "rtt_ms": 280, "queue_ms": 0, "t": 1}))
    assert cab.run(1.0, "w")[0] == {"x": 0, "z": 0.6, "y": 0, "valid_ms": 400}
