"""The scripted operator beside people at the operator page."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

from pebble.contract import AUTONOMY_COMMAND, AUTONOMY_FILES, AUTONOMY_STATUS, CONTROL, CONTROL_TAKE
from pebble.extensions.lab.demo.operator import TRAIL, Operator
from tests.kit.played_robot import RecordingRobot
from tests.support import Broker, until

BASE = "pebble/robots/goob"
ANNA = {"id": "3f2a91c0", "by": "anna", "for_ms": 10_000}
START_S = 5.0


@pytest.fixture
def robot(broker: Broker) -> Iterator[RecordingRobot]:
    with RecordingRobot(broker.port, BASE, keeps=True) as running:
        running.publish_capabilities(running.motors.value | {"autonomy": {"available": True}})
        running.publish(AUTONOMY_FILES.metric, {"files": [{"file": TRAIL}], "timestamp": 1}, retain=True)
        yield running


def scripts(robot: RecordingRobot) -> list[str | None]:
    """Return what it was asked to run; None: to end it."""
    topic = AUTONOMY_COMMAND.topic(BASE)
    return [payload.get("file") for _, name, payload in list(robot.received) if name == topic]


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


def test_a_robot_with_scripts_draws_its_trail_from_the_first_drive_on(
    robot: RecordingRobot, operator: Operator
) -> None:
    operator.begin("yours")
    assert until(lambda: robot.drives(0.0))
    assert until(lambda: scripts(robot) == [TRAIL])  # two subscriptions: one may be a moment later
    robot.publish(AUTONOMY_STATUS.metric, {"running": True, "timestamp": 1, "file": TRAIL})
    assert until(lambda: len(scripts(robot)) > 1, 30.0)
    assert scripts(robot)[:2] == [TRAIL, None], "it is ended before the emergency stop, which would make it fail"
