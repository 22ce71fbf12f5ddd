"""Processes end in order; an operator that is a program keeps rate and deadline, and lets people go first."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import pytest

from pebble.contract import channel_of
from pebble.contract.payloads import Drive
from pebble.extensions.lab.rig.processes import BROKERS, MCUS, OPERATORS, ROBOTS, Processes, Program
from pebble.extensions.lab.rig.scripted_operator import VALID_MS, ScriptedOperator
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.transports import Message, QoS
from tests.ext.operator.client.control_robot import KeepingRobot
from tests.ext.operator.client.estop_robot import Robot, capabilities
from tests.support import until


def write_when_ended(name: str, into: Path) -> list[str]:
    """A program that appends its name to a file when it gets SIGTERM."""
    return ["sh", "-c", f"trap 'echo {name} >> {into}; exit' TERM; touch {into}.{name}; while :; do sleep 0.01; done"]


def test_operators_end_first_and_brokers_last(tmp_path: Path) -> None:
    order = tmp_path / "order"
    with Processes() as processes:
        for name, kind in (("broker", BROKERS), ("mcu", MCUS), ("robot", ROBOTS), ("operator", OPERATORS)):
            processes.add(Program(name, write_when_ended(name, order), tmp_path / f"{name}.log"), kind)
            assert until(Path(f"{order}.{name}").exists)
        assert processes.unexpected_exits() == []
    assert order.read_text().split() == ["operator", "robot", "mcu", "broker"]
    assert not processes.folder.exists()


def test_one_that_ended_by_itself_is_named_and_one_that_was_ended_is_not(tmp_path: Path) -> None:
    with Processes() as processes:
        ended = processes.add(Program("the hub", ["true"], tmp_path / "hub.log"), BROKERS)
        assert until(lambda: ended.ended)
        assert processes.unexpected_exits() == [f"the hub ended unexpectedly: see {ended.log}"]
        processes.end(ended)
        assert processes.unexpected_exits() == []


BASE = "pebble/robots/mine"
DRIVE = f"{BASE}/incoming/drive-values"
CONTROL = {"drive": {"available": True, "control": True}, "estop": {"available": True, "owners": ["serial"]}}
ANN = {"id": "0badcafe", "by": "ann", "want": "hold", "for_ms": 3000}


class Given:
    """A robot with its real leases and latches, and its operator, whose waits take no time."""

    def __init__(self, value: dict[str, Any] | None = None) -> None:
        self.view = RobotView(BASE)
        self.keeping, self.latches = KeepingRobot(BASE), Robot(BASE, "serial")
        self.sent: list[Message] = []
        self.waited: list[float] = []
        self.operator = ScriptedOperator(self.view, self.publish, by="program", wait=self.wait)
        if value is not None:
            self.receive(capabilities(BASE, value), *self.keeping.states())

    def publish(self, message: Message) -> None:
        self.sent.append(message)
        self.receive(*self.keeping.take([message], time.monotonic()), *self.latches.take([message]))

    def person(self, metric: str, body: dict[str, Any]) -> None:
        message = Message(f"{BASE}/incoming/{metric}", json.dumps(body).encode(), QoS.DELIVERED)
        self.receive(*self.keeping.take([message], time.monotonic()), *self.latches.take([message]))

    def receive(self, *messages: Message) -> None:
        for message in messages:
            channel = channel_of(message.topic.removeprefix(f"{BASE}/"))
            self.view.receive(channel, message, time.monotonic(), time.time())
            self.operator.receive(message)

    def wait(self, seconds: float) -> bool:
        self.waited.append(seconds)
        return False

    @property
    def drives(self) -> list[dict[str, Any]]:
        return [json.loads(message.payload) for message in self.sent if message.topic == DRIVE]


def has_control(given: Given) -> bool:
    given.operator.ask_control()
    given.operator.tick()
    given.operator.tick()
    return given.operator.control.held


def test_it_drives_at_a_steady_rate_with_a_deadline_in_each_command_and_a_zero_at_the_end() -> None:
    given = Given()
    given.operator.drive(0.1, 0.5, 2.0)
    assert given.drives[:-1] == [{"x": 0.1, "z": 0.5, "y": 0, "valid_ms": VALID_MS}] * 40
    assert given.drives[-1] == {"x": 0, "z": 0, "y": 0, "valid_ms": VALID_MS}
    assert {message.qos for message in given.sent} == {QoS.DELIVERED}
    assert given.waited == sorted(given.waited)  # time does not pass: what is due moves on
    assert given.waited[-1] == pytest.approx(2.0, abs=0.5)


def interrupt() -> bool:
    raise KeyboardInterrupt


def test_whatever_ends_it_it_lets_go() -> None:
    given = Given()
    operator = ScriptedOperator(
        given.view, given.publish, by="program", wait=lambda _: len(given.drives) == 3 and interrupt()
    )
    with pytest.raises(KeyboardInterrupt):
        operator.drive(z=0.5)
    assert [drive["z"] for drive in given.drives] == [0.5, 0.5, 0.5, 0]


def test_it_drives_with_the_key_of_control_and_gives_it_back() -> None:
    given = Given(CONTROL)
    assert has_control(given)
    given.operator.command(Drive(z=0.5))
    state = given.view.control.state
    assert state is not None
    assert given.drives[-1]["key"] == state.key != ""
    given.operator.release()
    given.operator.command(Drive())
    assert "key" not in given.drives[-1]
    assert given.view.control.who == ""


def test_while_a_person_has_control_nothing_is_sent() -> None:
    given = Given(CONTROL)
    given.person("control", ANN)
    assert not has_control(given)
    assert not given.operator.has_control
    assert given.operator.command(Drive(z=0.5)) == float("inf")
    given.operator.drive(z=0.5, seconds=0.1)
    assert given.drives == []
    assert given.keeping.owners[0].by == "ann"


def test_a_person_who_asks_gets_control() -> None:
    given = Given(CONTROL)
    assert has_control(given)
    given.person("control", ANN)
    given.operator.command(Drive(z=0.5))
    given.person("control", ANN)
    assert given.keeping.owners[0].by == "ann"
    sent = len(given.drives)
    given.operator.command(Drive(z=0.5))
    assert len(given.drives) == sent


def test_a_stop_is_repeated_until_it_is_confirmed_and_reset_by_who_pressed_it() -> None:
    given = Given()
    given.operator.stop("a test")
    given.operator.tick()
    assert not given.operator.stopped  # nobody has told what it is
    given.receive(given.latches.capabilities(), *[owner.state() for owner in given.latches.owners])
    given.operator.tick()
    assert given.operator.stopped
    assert given.view.latched
    given.operator.reset()
    assert not given.view.latched
    given.person("estop", {"stop": "00c0ffee00c0ffee", "by": "ann"})
    given.operator.reset()
    assert given.view.latched, "a person's stop is left to the person"


def test_a_stop_of_a_person_is_left_to_the_person() -> None:
    given = Given()
    given.receive(given.latches.capabilities())
    given.person("estop", {"stop": "00c0ffee00c0ffee", "by": "ann"})
    given.operator.reset()
    assert given.sent == []
    assert given.view.latched
