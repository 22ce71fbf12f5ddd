"""The scripted operator beside people at the operator page, and which robots people have."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

from pebble.contract import CONTROL, CONTROL_TAKE, DRIVE, codec
from pebble.contract.payloads import Drive
from pebble.extensions.lab.demo.operator import Operator
from pebble.extensions.lab.demo.visitors import DRIVES_S, Visitors
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.transports import Message
from tests.kit.played_robot import RecordingRobot
from tests.support import Broker, until

BASE = "pebble/robots/goob"
ANNA = {"id": "3f2a91c0", "by": "anna", "for_ms": 10_000}


@pytest.fixture
def robot(broker: Broker) -> Iterator[RecordingRobot]:
    with RecordingRobot(broker.port, BASE, keeps=True) as running:
        yield running


@pytest.fixture
def operator(broker: Broker, robot: RecordingRobot) -> Iterator[Operator]:
    running = Operator(broker.port)
    running.connect()
    assert until(lambda: running.not_ready(["goob"]) == [])
    yield running
    running.close()


def test_a_robot_that_a_person_has_taken_is_left_alone_until_the_step_after(
    robot: RecordingRobot, operator: Operator
) -> None:
    operator.begin()
    assert until(lambda: robot.drives(0.0))
    assert robot.keeping is not None
    assert {drive.get("key") for drive in robot.drives()} == {robot.keeping.owners[0].lease.key}
    robot.command(CONTROL_TAKE.metric, ANNA)
    assert until(lambda: operator.activity.endswith("; goob is driven by anna"))
    taken = time.monotonic()
    assert not until(lambda: robot.drives(taken + 0.1), 1.0)
    robot.command(CONTROL.metric, ANNA | {"want": "release"})
    assert until(lambda: "goob" not in operator.activity)
    assert until(lambda: robot.drives(taken + 0.1))
    assert operator.visitors.left_alone == {"goob"}
    assert [one for one in operator.completed if one.ended > taken > one.began] == []


# -- visitors


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
