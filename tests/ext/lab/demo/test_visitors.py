"""Which robots people have, by the control of each and by the drive commands of others."""

from __future__ import annotations

import pytest

from pebble.contract import DRIVE, codec
from pebble.contract.payloads import Drive
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
