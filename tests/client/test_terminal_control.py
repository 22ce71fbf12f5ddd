"""A terminal at a robot that keeps control itself: control is asked for, had, and given back."""

from __future__ import annotations

import json
from typing import Any

from pebble.client.control import IDLE_S, ControlClient
from pebble.client.pace_of_link import WIDE
from pebble.transports import Message
from tests.client.control_robot import KeepingRobot
from tests.client.test_terminal_driver import DRIVE, DRIVING, GOOB, Cab, announcement

CONTROL = f"{GOOB}/incoming/control"


class KeepingCab(Cab):
    """A terminal, another driver, and motor owners that answer both."""

    def __init__(self, *, take_over: bool = False, published: bool = True) -> None:
        drive = {"available": True, "topic": DRIVE, "arbitrates": True, "control": True}
        super().__init__(take_over=take_over, drive=drive)
        self.keeping = KeepingRobot(GOOB, "serial")
        self.bob = ControlClient(self.driver.robot.control, by="bob", device="phone")
        self.bob_drives = False
        self._published = published
        self._answered = 0
        if published:
            self.receive(*self.keeping.states())

    def run(self, seconds: float, key: str = "") -> list[Any]:
        drives: list[Any] = []
        for _ in range(round(seconds / 0.05)):
            drives += super().run(0.05, key)
            sent, self._answered = self.sent[self._answered :], len(self.sent)
            if self.bob_drives and self.bob.key:
                self.keeping.owners[0].drive(self.bob.key, self.now)
            answers = self.keeping.take([*sent, *self.bob.tick(self.now)], self.now)
            self.receive(*(answers if self._published else []))
        return drives

    def bob_has_it(self) -> None:
        self.bob.ask(self.now)
        self.receive(*self.keeping.take(self.bob.tick(self.now), self.now))
        self.bob_drives = True

    @property
    def key(self) -> str:
        return self.keeping.owners[0].lease.key

    @property
    def mine(self) -> bool:
        return self.driver.control.held

    def type(self, key: str) -> None:
        self.driver.press([key], self.now)
        self.run(0.1)


def test_control_is_taken_at_the_start_and_every_command_has_its_key() -> None:
    cab = KeepingCab().ready()
    assert cab.mine
    assert cab.status.startswith("goob · ready")
    drives = cab.run(1.0, "w")
    assert {one["key"] for one in drives} == {cab.key}
    assert [one for one in cab.announced() if one] == [], "the robot tells it itself"
    released = cab.run(1.0)
    assert {one.get("key") for one in released} == {cab.key}, "the letting go of who has control"


def test_its_announcements_only_measure_the_way_through_the_broker() -> None:
    cab = KeepingCab().ready()
    cab.run(0.4, "w")
    cab.receive(next(message for message in reversed(cab.sent) if message.topic == DRIVING))
    cab.run(0.1)
    assert " ms" in cab.status
    cab.receive(announcement(9e9))
    assert cab.moves(), "what old servers announce counts for old robots"


def test_who_drives_is_asked_by_a_key_and_lets_this_terminal_drive() -> None:
    cab = KeepingCab()
    cab.bob_has_it()
    cab.ready()
    assert not cab.mine
    assert "bob (phone, name not checked) drives: t asks for control, o takes over" in cab.status
    assert not cab.moves()
    cab.type("t")
    assert "bob (phone, name not checked) drives: asked, o takes over" in cab.status
    cab.bob.release()
    cab.run(0.2)
    assert cab.mine
    assert cab.moves()


def test_control_that_another_has_at_the_start_is_taken_once_it_is_free() -> None:
    cab = KeepingCab()
    cab.bob_has_it()
    cab.ready()
    assert not cab.mine
    cab.bob.release()
    cab.run(0.2)
    assert cab.mine


def test_a_robot_that_does_not_answer_may_be_out_of_this_accounts_reach() -> None:
    cab = KeepingCab()
    cab.keeping.owners[0].receives = False
    cab.ready()
    cab.run(WIDE.answer_s + 1.0)
    assert "goob does not answer: may this account drive" in cab.status
    cab.keeping.owners[0].receives = True
    cab.type("t")
    assert cab.mine


def test_it_is_taken_over_by_a_key_or_at_the_start() -> None:
    for over in (False, True):
        cab = KeepingCab(take_over=over)
        cab.bob_has_it()
        cab.ready()
        assert cab.mine is over
        cab.type("o")
        assert cab.mine
        assert cab.bob.failed.endswith("has control now")
        assert cab.moves()


def test_who_loses_control_stops_and_needs_a_new_gesture() -> None:
    cab = KeepingCab().ready()
    assert cab.moves()
    cab.run(0.2, "w")
    cab.bob.ask(cab.now, over=True)
    drives = cab.run(0.5, "w")
    assert [one for one in drives[1:] if one["z"]] == []
    assert "bob (phone, name not checked) drives" in cab.status
    cab.bob.release()
    cab.type("t")
    assert [one for one in cab.run(1.0, "w") if one["z"]] == [], "the key was held all the time"
    assert cab.moves()


def test_who_asks_is_shown_and_may_be_let_or_not() -> None:
    cab = KeepingCab().ready()
    cab.run(0.5, "w")
    cab.bob.ask(cab.now)
    cab.run(0.2, "w")
    assert "bob asks for control: l lets bob drive, k keeps it" in cab.status
    cab.type("k")
    assert "bob asks" not in cab.status
    cab.bob.release()
    cab.run(0.2)
    cab.bob.ask(cab.now)
    cab.bob.passed_over = ""
    cab.driver.control.passed_over = ""
    cab.run(0.2, "w")
    cab.type("l")
    assert (cab.mine, cab.bob.held) == (False, True)


def test_after_a_minute_without_a_drive_it_is_given_back_and_a_key_takes_it_again() -> None:
    cab = KeepingCab().ready()
    cab.run(IDLE_S + 0.5)
    assert not cab.mine
    assert cab.keeping.owners[0].by == ""
    assert "nobody drives: t takes control" in cab.status
    cab.run(0.2, "w")
    assert cab.mine
    assert cab.moves()


def test_another_one_who_drives_without_control_is_shown() -> None:
    cab = KeepingCab().ready()
    state = json.loads(cab.keeping.owners[0].state().payload) | {"others": True}
    cab.receive(Message(f"{GOOB}/outgoing/control/serial", json.dumps(state).encode()))
    assert "somebody else drives, too" in cab.status


def test_a_robot_that_has_not_published_who_has_control_is_not_driven() -> None:
    cab = KeepingCab(published=False).ready()
    assert cab.run(1.0, "w") == []
    assert "goob has not published who has control" in cab.status


def test_the_end_stops_the_robot_and_gives_control_back() -> None:
    cab = KeepingCab().ready()
    cab.run(0.5, "w")
    zero, released, announced = cab.driver.leave(cab.now, 0.0)
    assert json.loads(zero.payload)["valid_ms"] == 0
    assert (released.topic, json.loads(released.payload)["want"]) == (CONTROL, "release")
    assert json.loads(announced.payload)["robots"] == {}
    assert cab.run(0.2) == [{"x": 0, "z": 0, "y": 0, "valid_ms": 0}] * 2
