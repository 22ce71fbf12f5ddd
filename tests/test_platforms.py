"""What operators use runs without what only Linux has: modules, system calls and signals are hidden from our code.

This is no substitute for a Mac or a Windows machine; it finds what would not even start there.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator

import pytest

from tests.commands.conftest import broker as broker
from tests.kit.played_robot import RecordingRobot
from tests.support import ROOT, Broker, until

ELSEWHERE = [sys.executable, str(ROOT / "tests" / "fakes" / "other_platform.py")]
MODULES = (
    *(f"pebble.extensions.operator.commands.{name}" for name in ("topic", "estop", "watch")),
    *(f"pebble.extensions.page.commands{name}" for name in ("", ".cert", ".drive")),
    "pebble.extensions.checks.commands.check",
    *(
        "pebble.extensions.page.app",
        "pebble.extensions.page.serve",
        "pebble.transports.mqtt.transport",
        "pebble.extensions.operator.client.media_receiver",
    ),
    *("pebble.extensions.foxglove.command", "pebble.extensions.foxglove.run"),
)


@pytest.fixture
def robot(broker: Broker) -> Iterator[RecordingRobot]:
    with RecordingRobot(broker.port, "pebble/robots/goob", heartbeats=False) as robot:
        robot.publish_states()
        yield robot


def elsewhere(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*ELSEWHERE, *arguments], cwd=ROOT, capture_output=True, text=True, stdin=subprocess.DEVNULL, timeout=60
    )


def test_modules_of_operators_can_be_imported() -> None:
    done = elsewhere("import", *MODULES)
    assert (done.returncode, done.stderr) == (0, "")
    assert "No module named 'fcntl'" in elsewhere("import", "pebble.launcher.forked").stderr, "else this proves nothing"


def test_commands_without_a_network() -> None:
    done = elsewhere("each", "--help", "topic --help", "web --help", "drive --help", "check configs/goob.json")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.count("Usage") == 4


def test_messages_are_published_and_received_and_a_robot_is_stopped(broker: Broker, robot: RecordingRobot) -> None:
    url = f"--url mqtt://127.0.0.1:{broker.port}"
    done = elsewhere(
        "each",
        f'topic pub drive-values {{"z":0.5}} {url} -r {robot.id}',
        f"topic echo capabilities --raw -n 1 {url} -r {robot.id}",
        f"estop {robot.id} {url}",
    )
    assert (done.returncode, done.stderr, robot.latched) == (0, "", True)
    assert until(lambda: robot.count("drive-values") >= 1)
    (capabilities,) = [line for line in done.stdout.splitlines() if line.startswith("{")]
    assert json.loads(capabilities)["value"]["estop"]["owners"] == ["serial"]
