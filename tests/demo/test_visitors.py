"""Which robots people have, by what servers announce and by who else drives."""

from __future__ import annotations

import pytest

from pebble.client.driver_lease import VALID_S
from pebble.client.robot_view import RobotView
from pebble.contract import CAPABILITIES, CONTROL_STATE, DRIVE, DRIVING, codec
from pebble.contract.payloads import Capabilities, ControlState, Drive, Driver, Driving
from pebble.demo.visitors import Visitors
from pebble.transports import Message

GOOB, FRED = (RobotView(f"pebble/robots/{name}") for name in ("goob", "fred"))


def announcement(server: str, *robots: RobotView, device: str = "phone", retain: bool = False) -> Message:
    driven = {robot.base: Driver(by="anna", device=device, since=1) for robot in robots}
    payload = codec.encode(DRIVING, Driving(t=1, robots=driven))
    return Message(DRIVING.topic(f"pebble/servers/{server}"), payload, retain=retain)


def test_a_robot_is_driven_while_a_server_announces_it() -> None:
    visitors = Visitors("me")

    def taken(now: float) -> tuple[str, str]:
        return visitors.taken(GOOB, now), visitors.taken(FRED, now)

    assert taken(10.0) == ("", "")
    visitors.receive(announcement("hall", GOOB), 10.0)
    assert taken(11.0) == ("is driven by anna on phone", "")
    visitors.receive(announcement("lab", FRED, device=""), 11.0)  # its silence about the other means nothing
    assert taken(11.0) == ("is driven by anna on phone", "is driven by anna")
    assert taken(10.0 + VALID_S) == ("", "is driven by anna")


def test_a_robot_that_was_driven_is_left_alone_until_the_step_after() -> None:
    visitors = Visitors("me")
    visitors.begin_step(9.0)
    visitors.receive(announcement("hall", GOOB), 10.0)
    assert [visitors.free(robot, 20.0) for robot in (GOOB, FRED)] == [False, True]
    assert visitors.left_alone == {"goob"}
    visitors.begin_step(20.0)
    assert visitors.free(GOOB, 20.0)


@pytest.mark.parametrize(
    "message", [Message(DRIVING.topic("pebble/servers/hall"), b"{"), announcement("hall", GOOB, retain=True)]
)
def test_what_is_no_announcement_of_now_is_ignored(message: Message) -> None:
    visitors = Visitors("me")
    visitors.receive(message, 1.0)
    assert visitors.taken(GOOB, 1.0) == ""


OURS, PASTED = codec.encode(DRIVE, Drive(z=0.6)), b'{"x": 0, "z": 0.3}'
TOPIC = DRIVE.topic(GOOB.base)


@pytest.mark.parametrize(
    ("received", "taken"),
    [
        ([Message(TOPIC, OURS)], ""),
        ([Message(TOPIC, PASTED)], "is driven by another program"),
        ([Message(TOPIC, OURS), Message(TOPIC, OURS)], "is driven by another program"),  # one of them is not ours
        ([Message(TOPIC, PASTED, retain=True)], ""),  # it moves nothing
        ([Message(TOPIC, PASTED), announcement("hall", GOOB)], "is driven by anna on phone"),
        ([announcement("hall", GOOB), Message(TOPIC, PASTED)], "is driven by anna on phone"),
    ],
    ids=["own", "pasted", "own and the same", "retained", "then announced", "announced before"],
)
def test_a_command_that_the_operator_has_not_sent_is_another_drivers(received: list[Message], taken: str) -> None:
    visitors = Visitors("me")
    visitors.note_sent(TOPIC, OURS)
    for message in received:
        (visitors.receive_drive if message.topic == TOPIC else visitors.receive)(message, 10.0)
    assert [visitors.taken(robot, 11.0) for robot in (GOOB, FRED)] == [taken, ""]
    assert visitors.free(GOOB, 20.0) is (taken == "")
    visitors.begin_step(20.0)
    assert visitors.free(GOOB, 20.0)


def test_a_page_that_has_control_and_a_pasted_command_both_keep_the_operator_away() -> None:
    visitors, robot = Visitors("me"), RobotView(GOOB.base)

    def publishes(by: str) -> None:
        what = {"drive": {"control": True}, "estop": {"owners": ["serial"]}}
        state = ControlState(by=by, id=by and "3f2a91c0", key=by and "0badf00d")
        for channel, payload in ((CAPABILITIES, Capabilities(t=1, value=what)), (CONTROL_STATE, state)):
            topic = channel.topic(robot.base).format(owner="serial")
            robot.receive(channel, Message(topic, codec.encode(channel, payload)), 10.0, 10.0)

    publishes("anna")
    assert visitors.taken(robot, 10.0) == "is driven by anna"
    assert visitors.rests(robot, 10.0), "it is not moved"
    visitors.receive_drive(Message(TOPIC, PASTED), 20.0)
    assert visitors.taken(robot, 20.0) == "is driven by anna"
    assert not visitors.rests(robot, 20.0)
    publishes("")
    assert visitors.taken(robot, 20.0 + VALID_S / 2)
    visitors.begin_step(30.0)
    assert visitors.free(robot, 30.0)
