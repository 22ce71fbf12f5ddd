"""What operators use runs without what only Linux has: modules, system calls and signals are hidden from our code.

This is no substitute for a Mac or a Windows machine; it finds what would not even start there.
"""

from __future__ import annotations

import json
import os
import pty
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.commands.conftest import broker as broker
from tests.kit.played_robot import RecordingRobot
from tests.support import ROOT, THOROUGH, Broker, Child, free_port, until

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


@pytest.mark.parametrize("modules", MODULES if THOROUGH else [MODULES], ids=str)
def test_it_can_be_imported(modules: str | tuple[str, ...]) -> None:
    done = elsewhere("import", *([modules] if isinstance(modules, str) else modules))
    assert (done.returncode, done.stderr) == (0, "")


def test_what_is_hidden_is_missed() -> None:
    """Else the other tests would prove nothing."""
    assert "No module named 'fcntl'" in elsewhere("import", "pebble.launcher.forked").stderr


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


def test_driving_by_keys_is_refused_with_what_to_use() -> None:
    terminal, side = pty.openpty()
    done = subprocess.run(
        [*ELSEWHERE, "drive", "goob", "--url", "mqtt://127.0.0.1:1"],
        cwd=ROOT, stdin=side, stdout=side, stderr=subprocess.PIPE, text=True, timeout=60, check=False,
    )  # fmt: skip
    os.close(side)
    os.close(terminal)
    assert done.stderr.startswith("pebble: driving by keys needs a terminal of Linux or macOS: use `pebble web`, ")


def test_the_operator_page_is_served(broker: Broker, tmp_path: Path) -> None:
    port = free_port()
    options = ("--url", f"mqtt://127.0.0.1:{broker.port}", "--port", str(port), "--people", str(tmp_path / "people"))
    page = Child([*ELSEWHERE, "web", *options], cwd=ROOT, stdout=subprocess.DEVNULL)
    try:
        assert until(lambda: healthy(port), 20)
    finally:
        page.terminate()
        page.wait(10)


def healthy(port: int) -> bool:
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/healthz", timeout=2) as answer:
            return bool(answer.status == 200)
    except OSError:
        return False
