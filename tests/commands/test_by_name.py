"""Tools find robots, and show what is retained, where a broker sends it for exact names only."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.commands.command_line import Run
from tests.commands.test_estop import Heartbeat, LiveRobot
from tests.sparing_broker import SparingBroker
from tests.support import Broker

STOPPED = "stopped by ann@desk"


@pytest.fixture
def url(broker: Broker) -> Iterator[str]:
    sparing = SparingBroker(broker.port, by_name=True)
    yield f"--url=mqtt://127.0.0.1:{sparing.port}"
    sparing.close()


@pytest.fixture
def robot(broker: Broker) -> Iterator[LiveRobot]:
    """It is stopped already, and sends heartbeats."""
    robot = LiveRobot(broker.port, "left", "right")
    robot.stop()
    robot.set_flag("mqtt-video")
    heartbeat = Heartbeat(robot)
    yield robot
    heartbeat.stop()
    robot.close()


CASES = {
    "topic list": ["outgoing/capabilities", "outgoing/estop/right", "incoming/flags/mqtt-video", f"is {STOPPED}"],
    "topic list --robot {id}": ["outgoing/capabilities", "outgoing/estop/left", f"is {STOPPED}"],
    "topic list +/+/+/outgoing/capabilities": ["outgoing/capabilities  yes"],
    "topic pub drive-values {drive} --robot {id}": [f"is {STOPPED}"],
    "estop status": [STOPPED, "dog (left)", "dog (right)"],
    "estop status {id}": [STOPPED, "dog (left)", "dog (right)"],
    "estop reset {id}": [STOPPED, "dog (left)", "dog (right)", "free; it moves again"],
    "estop --all": ["stopped and confirmed after"],
}


def shown(text: str) -> str:
    return " ".join(text.split())


@pytest.mark.parametrize(("line", "expected"), CASES.items(), ids=CASES)
def test_what_is_retained_is_asked_for(run: Run, robot: LiveRobot, url: str, line: str, expected: list[str]) -> None:
    words = [word.format(id=robot.id, drive='{"z":1}') if "{" in word else word for word in line.split()]
    run(*words, url, columns=120)
    assert [text for text in expected if shown(text) not in shown(run.out + run.err)] == [], run.out + run.err
