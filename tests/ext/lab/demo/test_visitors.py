"""Which robots people have, by the control of each and by the drive commands of others."""

from __future__ import annotations

import pytest

from pebble.contract import CAPABILITIES, CONTROL_STATE, DRIVE, codec
from pebble.contract.payloads import Capabilities, ControlState, Drive
from pebble.extensions.lab.demo.visitors import DRIVES_S, Visitors
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.transports import Message

GOOB, FRED = (RobotView(f"pebble/robots/{name}") for name in ("goob", "fred"))
OURS, PASTED = codec.encode(DRIVE, Drive(z=0.6)), b'{"x": 0, "z": 0.3}'
TOPIC = DRIVE.topic(GOOB.base)


@pytest.mark.parametrize(
    ("received", "taken"),
    [
        ([Message(TOPIC, OURS)], ""),
        ([Message(TOPIC, PASTED)], "is driven by another program"),
        ([Message(TOPIC, OURS), Message(TOPIC, OURS)], "is driven by another program"),  # one of them is not ours
        ([Message(TOPIC, PASTED, retain=True)], ""),  # it moves nothing
    ],
    ids=["own", "pasted", "own and the same", "retained"],
)
def test_a_command_that_the_operator_has_not_sent_is_another_drivers(received: list[Message], taken: str) -> None:
    visitors = Visitors("me")
    visitors.note_sent(TOPIC, OURS)
    for message in received:
        visitors.receive_drive(message, 10.0)
    assert [visitors.taken(robot, 11.0) for robot in (GOOB, FRED)] == [taken, ""]
    assert visitors.taken(GOOB, 10.0 + DRIVES_S) == ""
    assert [visitors.free(robot, 20.0) for robot in (GOOB, FRED)] == [taken == "", True]
    assert visitors.left_alone == ({"goob"} if taken else set())
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
    assert visitors.taken(robot, 20.0 + DRIVES_S / 2)
    visitors.begin_step(30.0)
    assert visitors.free(robot, 30.0)
