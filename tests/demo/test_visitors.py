"""Which robots people drive, by what servers announce."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import pytest

from pebble.client.driver_lease import VALID_S
from pebble.client.robot_view import RobotView
from pebble.contract import DRIVING, codec
from pebble.contract.payloads import Driver, Driving
from pebble.demo.operator import Operator
from pebble.transports import Message

GOOB, FRED = (RobotView(f"pebble/robots/{name}") for name in ("goob", "fred"))


def announcement(server: str, *robots: RobotView, device: str = "phone") -> Message:
    driven = {robot.base: Driver(by="anna", device=device, since=1) for robot in robots}
    return Message(DRIVING.topic(f"pebble/servers/{server}"), codec.encode(DRIVING, Driving(t=1, robots=driven)))


@pytest.fixture
def operator() -> Iterator[Operator]:
    made = Operator(1)
    yield made
    made.close()


@pytest.fixture
def at(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """Sets the time."""
    return lambda now: monkeypatch.setattr(time, "monotonic", lambda: now)


def test_a_robot_is_driven_while_a_server_announces_it(operator: Operator, at: Callable[[float], None]) -> None:
    at(10.0)
    assert operator._taken(GOOB) == ""
    operator._note_visits(announcement("hall", GOOB))
    at(11.0)
    assert operator._taken(GOOB) == "is driven by anna on phone"
    assert operator._taken(FRED) == ""
    operator._note_visits(announcement("lab", FRED, device=""))  # its silence about the other means nothing
    assert operator._taken(GOOB) == "is driven by anna on phone"
    assert operator._taken(FRED) == "is driven by anna"
    at(10.0 + VALID_S)
    assert operator._taken(GOOB) == ""
    assert operator._taken(FRED) == "is driven by anna"


def test_a_robot_that_was_driven_is_left_alone_until_the_step_after(
    operator: Operator, at: Callable[[float], None]
) -> None:
    at(9.0)
    operator._begin("a step", [GOOB, FRED])
    at(10.0)
    operator._note_visits(announcement("hall", GOOB))
    at(20.0)
    assert [operator._mine(robot) for robot in (GOOB, FRED)] == [False, True]
    assert operator.left_alone == {"goob"}
    operator._begin("the step after", [GOOB, FRED])
    assert operator._mine(GOOB)


def test_what_is_no_announcement_is_ignored(operator: Operator) -> None:
    operator._note_visits(Message(DRIVING.topic("pebble/servers/hall"), b"{"))
    assert operator._taken(GOOB) == ""
