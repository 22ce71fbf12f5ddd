"""Who is stopped by what a robot publishes, and what a reset may end."""

from __future__ import annotations

import json

import pytest

from pebble.extensions.operator.client.driveable import driveable_of
from pebble.extensions.operator.client.estop_states import MAX_OWNERS, Reset, RobotEstop
from pebble.transports import Message
from tests.ext.operator.client.estop_robot import Robot, capabilities, outgoing

GOOB = "pebble/robots/goob"
STOP = {"stop": "0123456789abcdef", "by": "ann@desk", "why": "dog"}
STATE = {"latched": True, "boot": "00c0ffee", "count": 1, "recent": [], "by": "ann", "why": "dog", "since": 5}


def stopped(*names: str) -> tuple[Robot, RobotEstop]:
    """A robot with these owners, all stopped, and what a client has received from it."""
    robot, estop = Robot(GOOB, *names), RobotEstop(GOOB)
    estop.receive(robot.capabilities())
    stop(robot, estop, STOP)
    return robot, estop


def stop(robot: Robot, estop: RobotEstop, body: dict[str, str]) -> None:
    publish(estop, robot.take([Message(f"{GOOB}/incoming/estop", json.dumps(body).encode())]))


def publish(estop: RobotEstop, messages: list[Message]) -> None:
    for message in messages:
        estop.receive(message)


def test_a_robot_is_stopped_if_any_owner_is() -> None:
    robot, estop = Robot(GOOB, "left", "right"), RobotEstop(GOOB)
    publish(estop, [robot.capabilities(), *(owner.state() for owner in robot.owners)])
    assert (estop.latched, estop.stopped_by, estop.old) == ({}, None, False)
    robot.owners[1].latch.stop(STOP["stop"], "ann@desk", "dog", 7)
    publish(estop, [robot.owners[1].state()])
    assert list(estop.latched) == ["right"]
    assert estop.stopped_by is not None
    assert (estop.stopped_by.by, estop.stopped_by.why, estop.stopped_by.since) == ("ann@desk", "dog", 7)


def test_the_retained_state_of_an_owner_that_was_removed_does_not_count() -> None:
    estop = RobotEstop(GOOB)
    assert estop.receive(outgoing(GOOB, "estop/removed", STATE, retain=True))
    assert list(estop.latched) == ["removed"], "as long as the owners are not known"
    estop.receive(Robot(GOOB, "serial").capabilities())
    assert estop.latched == {}
    estop.receive(capabilities(GOOB, {}))
    assert (estop.latched, estop.old) == ({}, True)


def test_an_empty_message_removes_a_state() -> None:
    estop = RobotEstop(GOOB)
    estop.receive(outgoing(GOOB, "estop/serial", STATE))
    assert estop.receive(Message(f"{GOOB}/outgoing/estop/serial", b""))
    assert estop.states == {}


@pytest.mark.parametrize(
    "body",
    [{}, "x", STATE | {"latched": 1}, STATE | {"why": "x" * 2000}],
)
def test_what_is_no_state_changes_nothing(body: object) -> None:
    estop = RobotEstop(GOOB)
    assert not estop.receive(outgoing(GOOB, "estop/serial", body))
    assert not estop.receive(outgoing(GOOB, "capabilities", body))
    assert not estop.receive(outgoing(GOOB, "online", STATE))
    assert (estop.states, estop.has_capabilities) == ({}, False)


def test_texts_of_states_are_short_and_harmless() -> None:
    estop = RobotEstop(GOOB)
    state = STATE | {"by": "\x1b]0;evil\x07" + "x" * 99, "why": "\u202e" * 41, "since": 10**40, "recent": ["n"] * 20}
    assert estop.receive(outgoing(GOOB, "estop/serial", state))
    clean = estop.states["serial"]
    assert (clean.by[:9], len(clean.by), clean.why, clean.since) == ("?]0;evil?", 32, "?" * 40, 0)
    assert len(clean.recent) == 8


def test_the_number_of_owners_is_limited_and_listed_ones_are_preferred() -> None:
    estop = RobotEstop(GOOB)
    for number in range(3 * MAX_OWNERS):
        estop.receive(outgoing(GOOB, f"estop/o{number}", STATE))
    assert len(estop.states) == MAX_OWNERS
    estop.receive(Robot(GOOB, "serial").capabilities())
    assert estop.receive(outgoing(GOOB, "estop/serial", STATE))
    for number in range(3 * MAX_OWNERS):
        estop.receive(outgoing(GOOB, f"estop/p{number}", STATE))
    assert list(estop.latched) == ["serial"]


# -- resets


def test_a_reset_frees_each_owner_by_its_own_boot_and_count() -> None:
    robot, estop = stopped("left", "right")
    reset = Reset(estop, "ann@desk")
    assert [json.loads(message.payload) for message in reset.messages()] == [
        {"boot": "00000000", "count": 1, "by": "ann@desk"},
        {"boot": "00000001", "count": 1, "by": "ann@desk"},
    ]
    assert {message.topic for message in reset.messages()} == {f"{GOOB}/incoming/estop-reset"}
    assert (reset.waiting, reset.free) == (["left", "right"], False)
    publish(estop, robot.take(reset.messages()))
    assert estop.states["left"].reset_refused == "boot", "by the other owner's reset, which does not matter"
    assert (reset.waiting, reset.free, reset.refusals()) == ([], True, {})


def test_only_stopped_owners_are_reset() -> None:
    robot, estop = stopped("left", "right")
    latch = robot.owners[0].latch
    assert latch.reset(latch.boot, latch.count, age=0, now=0)
    publish(estop, [robot.owners[0].state()])
    assert list(Reset(estop, "").shown) == ["right"]


def test_a_reset_ends_no_stop_that_was_not_shown() -> None:
    robot, estop = stopped("serial")
    reset = Reset(estop, "ann@desk")
    stop(robot, estop, {"stop": "fedcba9876543210", "by": "bob"})
    assert [json.loads(message.payload)["count"] for message in reset.messages()] == [1]
    publish(estop, robot.take(reset.messages()))
    assert robot.owners[0].latch.latched
    assert (reset.waiting, reset.free) == ([], False)
    assert reset.refusals() == {"serial": "stopped again meanwhile by bob"}


def test_a_reset_reports_owners_that_have_restarted_or_are_silent() -> None:
    robot, estop = stopped("left", "right")
    reset = Reset(estop, "ann@desk")
    publish(estop, [outgoing(GOOB, "estop/left", STATE | {"boot": "12345678"})])
    assert reset.waiting == ["right"]
    assert reset.refusals() == {"left": "it has restarted since", "right": "no answer (may this account reset it?)"}
    robot.owners[1].latch.reset("00000001", 1, age=1000, now=0)
    publish(estop, [robot.owners[1].state()])
    assert reset.refusals()["right"] == "the reset reached it too late"


WHY = "serial: no /dev/ttyACM0"


@pytest.mark.parametrize(
    ("driveable", "doubt"),
    [
        ({"state": "no", "why": WHY}, f"CANNOT BE DRIVEN OR STOPPED: {WHY}"),
        ({"state": "unknown", "why": WHY}, f"not known whether its motors obey: {WHY}"),
        ({"state": "no", "why": "x" * 9000}, f"CANNOT BE DRIVEN OR STOPPED: {'x' * 300}"),
        ({"state": "yes"}, ""),
        (None, None),  # an older robot
        ({"state": ["no"]}, None),
    ],
)
def test_a_status_tells_whether_a_robot_can_be_driven(driveable: object, doubt: str | None) -> None:
    found = driveable_of(json.dumps({"t": 1, "value": {"services": {}, "driveable": driveable}}).encode())
    assert (found and found.doubt) == doubt
