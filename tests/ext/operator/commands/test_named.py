"""Commands to a robot that takes them only with a name, over a real broker: with an account, and without one."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import pytest

from tests.commands.command_line import Run
from tests.kit.played_robot import RecordingRobot
from tests.support import Broker, until

NAMES = itertools.count(1)
COMMANDS: list[tuple[list[str], list[str], bool]] = [
    (["topic", "pub", "lights-solid", '{"r": 1}'], ["by/ann/lights-solid"], False),
    (["topic", "pub", "drive-values", '{"z": 0.5}'], ["by/ann/drive-values"], False),
    (["topic", "pub", "flags/mqtt-video", "true"], ["by/ann/flags/mqtt-video"], False),
    (["topic", "pub", "estop", "{}"], ["estop", "by/ann/estop"], True),
    (["topic", "pub", "lights-solid", '{"r": 1}', "--force"], ["lights-solid"], True),
]


@pytest.fixture
def robot(broker: Broker) -> Iterator[RecordingRobot]:
    with RecordingRobot(broker.port, f"pebble/robots/named{next(NAMES)}", named=True) as one:
        yield one


def incoming(robot: RecordingRobot) -> set[str]:
    return {one.removeprefix(f"{robot.base}/incoming/") for one in robot.wire}


@pytest.mark.parametrize(("words", "topics", "is_free"), COMMANDS)
def test_a_message_has_the_user_name_at_the_broker_in_its_topic(
    broker: Broker, robot: RecordingRobot, run: Run, words: list[str], topics: list[str], is_free: bool
) -> None:
    name = robot.base.rpartition("/")[2]
    assert run(*words, "--url", f"mqtt://ann@127.0.0.1:{broker.port}", "--robot", name) == 0, run.err
    assert until(lambda: incoming(robot) == set(topics))
    robot.wire.clear()
    code = run(*words, "--url", f"mqtt://127.0.0.1:{broker.port}", "--robot", name)
    assert (code == 0) is is_free
    assert (f"pebble: {name} takes commands only with a name, and there is none here: log in" in run.err) is not is_free
    assert until(lambda: incoming(robot) == ({topics[0]} if is_free else set()))


def test_a_stop_goes_both_ways_and_a_reset_by_name(broker: Broker, robot: RecordingRobot, run: Run) -> None:
    name, url = robot.base.rpartition("/")[2], f"mqtt://ann@127.0.0.1:{broker.port}"
    assert run("estop", name, "--url", url) == 0, run.err
    assert {"estop", "by/ann/estop"} <= incoming(robot)
    assert run("estop", "reset", name, "--url", f"mqtt://127.0.0.1:{broker.port}") == 1
    assert "takes commands only with a name" in run.err
    assert run("estop", "reset", name, "--url", url) == 0, run.err
    assert {one for one in incoming(robot) if one.endswith("reset")} == {"by/ann/estop-reset"}
