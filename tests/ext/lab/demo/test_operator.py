"""The scripted operator beside people at the operator page."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

from pebble.contract import CONTROL, CONTROL_TAKE
from pebble.extensions.lab.demo.operator import Operator
from tests.kit.played_robot import RecordingRobot
from tests.support import Broker, until

BASE = "pebble/robots/goob"
ANNA = {"id": "3f2a91c0", "by": "anna", "for_ms": 10_000}
START_S = 5.0


@pytest.fixture
def robot(broker: Broker) -> Iterator[RecordingRobot]:
    with RecordingRobot(broker.port, BASE, keeps=True) as running:
        yield running


@pytest.fixture
def operator(broker: Broker, robot: RecordingRobot) -> Iterator[Operator]:
    running = Operator(broker.port)
    running.connect()
    assert until(lambda: running.not_ready(["goob"]) == [], START_S)
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
    assert until(lambda: "goob" not in operator.activity, START_S)
    assert until(lambda: robot.drives(taken + 0.1), START_S)
    assert operator.visitors.left_alone == {"goob"}
    assert [one for one in operator.completed if one.ended > taken > one.began] == []
