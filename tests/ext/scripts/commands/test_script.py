"""``pebble script`` with a real broker and a robot whose manager is scripted, and programs to begin with."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from pebble.contract import AUTONOMY_COMMAND, AUTONOMY_FILES, AUTONOMY_STATUS, STATUS, WHEEL_ODOMETRY, Channel, codec
from pebble.contract.payloads import AutonomyFiles, AutonomyStatus, Status, WheelOdometry
from pebble.errors import PebbleError
from pebble.extensions.lab.simulation.world.script_robot import SimulatedRobot
from pebble.extensions.operator.client.scripts import settings
from pebble.transports import Message, MqttSettings, QoS, create
from tests.commands.command_line import GOOB, Run, config_file
from tests.support import ROOT, Broker, until

FORM: list[dict[str, Any]] = [
    {"key": "tag_id", "label": "Tag ID", "type": "int", "default": 13, "arg": "--tag-id", "min": 0, "max": 34},
    {"key": "speed", "label": "Speed", "type": "enum", "default": "slow", "arg": "-s", "options": ["slow", "fast"]},
    {"key": "search", "label": "Search", "type": "bool", "default": True, "arg": "--search", "mode": "flag"},
    {"key": "size_m", "label": "Size", "type": "float", "default": None, "arg": "--size-m", "required": True},
]
ENTRY = {"file": "follow", "label": "Follow a tag", "configs": FORM}


class Manager:
    """Publishes one script; answers each command with the next of its statuses, and a moment later with ``then``."""

    def __init__(self, port: int) -> None:
        self.commands: list[dict[str, Any]] = []
        self.answers: list[AutonomyStatus] = []
        self._transport = create("mqtt", "manager", MqttSettings(host="127.0.0.1", port=port)).open()
        self._transport.subscribe(AUTONOMY_COMMAND.topic(GOOB), self._receive)
        self.then: list[AutonomyStatus] = []
        self.offer("follow")
        self.publish(AutonomyStatus(running=False, timestamp=1.0))

    def offer(self, file: str, **more: bool) -> None:
        self._publish(AUTONOMY_FILES, AutonomyFiles(files=[ENTRY | {"file": file} | more], timestamp=1.0))

    def publish(self, status: AutonomyStatus) -> None:
        self._publish(AUTONOMY_STATUS, status)

    def judge(self, state: str, why: str = "") -> None:
        """Say whether the motors obey."""
        self._publish(STATUS, Status(value={"driveable": {"state": state, "why": why}}))

    def close(self) -> None:
        self._transport.close()

    def _publish(self, channel: Any, value: Any) -> None:
        self._transport.publish(channel.topic(GOOB), codec.encode(channel, value), qos=QoS.DELIVERED, retain=True)

    def _receive(self, message: Message) -> None:
        self.commands.append(json.loads(message.payload))
        self.publish(self.answers.pop(0))
        for status in self.then:
            threading.Timer(0.2, self.publish, [status]).start()


@pytest.fixture
def config(broker: Broker, tmp_path: Path) -> Path:
    return config_file(tmp_path, local_mqtt={"host": "127.0.0.1", "port": broker.port})


@pytest.fixture
def manager(broker: Broker) -> Iterator[Manager]:
    manager = Manager(broker.port)
    yield manager
    manager.close()


def test_it_lists_scripts_and_their_options(run: Run, config: Path, manager: Manager) -> None:
    assert run("script", "list", config) == 0, run.err
    assert [line.strip().split("  ")[0] for line in run.out.splitlines()] == [
        "follow: Follow a tag", "--tag-id INT", "--speed ENUM", "[--search | --no-search]", "--size-m FLOAT",
        "no script runs",
    ]  # fmt: skip
    assert "(min 0; max 34; default: 13)" in run.out
    assert "(slow, fast; default: slow)" in run.out


@pytest.mark.parametrize(("there", "typed"), [("follow", "follow"), ("fo\u0308llow", "f\u00f6llow")])
def test_it_starts_a_script_with_options(run: Run, config: Path, manager: Manager, there: str, typed: str) -> None:
    manager.offer(there)
    effective = {"tag_id": 7, "search": False}
    manager.answers = [AutonomyStatus(running=True, timestamp=2.0, file=there, pid=42, config=effective)]
    assert run("script", "start", config, typed, "--tag-id", "7", "--no-search", "--size-m=0.2") == 0, run.err
    chosen = {"tag_id": 7, "search": False, "size_m": 0.2}
    assert manager.commands == [{"action": "start", "file": there, "config": chosen}]
    assert run.out.splitlines() == [f"{there} runs (process 42)", "    tag_id: 7", "    search: False"]


def test_a_script_that_dies_at_once_is_an_error(run: Run, config: Path, manager: Manager) -> None:
    manager.answers = [AutonomyStatus(running=True, timestamp=2.0, file="follow", pid=42)]
    manager.then = [AutonomyStatus(running=False, timestamp=3.0, error="follow exited with code 1")]
    assert run("script", "start", config, "follow") == 1
    assert run.err == "pebble: follow exited with code 1\n"


def test_a_start_without_a_script_names_the_command_that_lists_them(run: Run, config: Path) -> None:
    assert run("script", "start", config, "--tag-id", "7") == 1
    assert run.err == f'pebble: which script? see "pebble script list {config}"\n'


def test_a_script_that_was_not_asked_yet_is_not_started(run: Run, config: Path, manager: Manager) -> None:
    manager.offer("follow", asked=False)
    assert run("script", "start", config, "follow") == 1
    assert run.err == "pebble: the robot has just started, and still asks follow what it needs: try again\n"


def test_by_url_it_needs_the_robots_id(run: Run, broker: Broker, manager: Manager) -> None:
    manager.answers = [AutonomyStatus(running=False, timestamp=2.0)]
    assert run("script", "stop", "goob", "--url", f"mqtt://127.0.0.1:{broker.port}") == 0, run.err
    assert until(lambda: manager.commands == [{"action": "stop"}])
    assert run.out == "no script runs\n"


def test_a_refused_start_is_an_error_even_if_the_script_runs_already(run: Run, config: Path, manager: Manager) -> None:
    running = {"running": True, "file": "follow", "pid": 42}
    manager.publish(AutonomyStatus(timestamp=2.0, **running))
    error = "Invalid config for follow: missing size_m"
    manager.answers = [AutonomyStatus(timestamp=3.0, error=error, **running)]
    assert run("script", "start", config, "follow", "--tag-id", "1") == 1
    assert run.err == f"pebble: {error}\n"


def test_the_list_ends_with_what_runs(run: Run, config: Path, manager: Manager) -> None:
    manager.publish(AutonomyStatus(running=False, timestamp=2.0, error="follow exited with code 3"))
    assert run("script", "list", config) == 0
    assert run.out.splitlines()[-2:] == ["no script runs", "error: follow exited with code 3"]
    manager.publish(AutonomyStatus(running=True, timestamp=2.0, file="follow", pid=4, overridden=True))
    assert run("script", "list", config) == 0
    assert run.out.splitlines()[-1] == "follow runs (process 4), but a person drives: it waits"
    manager.judge("no", "serial: no board")
    assert run("script", "list", config) == 0
    assert run.out.splitlines()[-1] == "goob: Cannot be driven: serial: no board"
    manager.judge("yes")


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["--tagid", "3"], "--tagid is no option of follow: --tag-id, --speed, --search, --no-search, --size-m"),
        (["--tag-id"], "--tag-id needs a value"),
        (["--tag-id", "x"], "--tag-id of follow: tag_id must be a whole number"),
        (["--search=off"], "--search takes no value: its opposite is an option of its own"),
    ],
)
def test_wrong_options_are_named(words: list[str], problem: str) -> None:
    with pytest.raises(PebbleError) as error:
        settings(ENTRY, words)
    assert str(error.value) == problem


@pytest.mark.parametrize(
    "words", [["--marker-id=7", "--preview"], ["--tag-id", "7", "--preview"]], ids=["own", "by key"]
)
def test_an_option_is_the_scripts_own_or_made_of_its_key(words: list[str]) -> None:
    form = [
        {"key": "tag_id", "type": "int", "arg": "--marker-id"},
        {"key": "preview", "type": "bool", "arg": "--preview"},
    ]
    assert settings({"file": "follow", "configs": form}, words) == {"tag_id": 7, "preview": True}


# -- what ``pebble script new`` writes works as it is, and its test would notice if it did not


def pytest_in(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *arguments]
    environment = {**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}  # users have none; ours take seconds to import
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, env=environment)


@pytest.fixture
def folder(run: Run, tmp_path: Path) -> Path:
    assert run("script", "new", "follow-me", "--folder", tmp_path) == 0, run.err
    folder = tmp_path / "follow-me"
    files = ["run.py", "test_follow_me.py", "room.json", "goob.json", "pytest.ini"]
    assert run.out.splitlines() == [str(folder / file) for file in files]
    return folder


@pytest.mark.thorough
def test_its_test_passes_and_fails_for_a_robot_that_turns_away(folder: Path) -> None:
    assert "1 passed" in pytest_in(folder).stdout
    script = folder / "run.py"
    script.write_text(script.read_text().replace("0.35 * tag", "-0.35 * tag"))
    assert "1 failed" in pytest_in(folder).stdout


def test_it_is_a_script_of_less_than_30_lines(folder: Path) -> None:
    script = folder / "run.py"
    assert script.read_text().count("\n") < 30
    done = subprocess.run([sys.executable, script, "--describe"], capture_output=True, text=True, check=True)
    described = json.loads(done.stdout)
    assert described["label"] == "follow-me"
    assert [entry["arg"] for entry in described["configs"]] == ["--tag-id", "--distance-m"]


def test_its_robot_is_one_and_its_folder_is_left_alone_the_next_time(folder: Path, run: Run) -> None:
    assert run("check", folder / "goob.json") == 0, run.err
    assert "autonomy_manager" in run.out
    assert run("script", "new", "follow-me", "--folder", folder.parent) == 1
    assert run.err == f"pebble: {folder} exists already: choose another name, or another --folder\n"


@pytest.mark.parametrize("name", ["../out", "1st", "x" * 80])
def test_a_name_that_no_module_could_have_is_refused(name: str, run: Run, tmp_path: Path) -> None:
    assert run("script", "new", name, "--folder", tmp_path) == 1
    assert run.err.startswith(f"pebble: {name!r}: a script's name is letters, digits, - and _")


# -- the programs in docs/ext/scripts.md run as they stand there


def programs(beginning: str) -> list[str]:
    text = (ROOT / "docs/ext/scripts.md").read_text()
    return [block for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if block.startswith(beginning)]


class Driven(SimulatedRobot):
    """Its odometry is the truth, until it ends after 1.5 s: half of the way."""

    def latest(self, channel: Channel, max_age: float = 1.0) -> Any:
        start = self._start = getattr(self, "_start", self.body.pose)
        if self.world.now() < 1.5:
            way = ((self.body.pose.x - start.x) ** 2 + (self.body.pose.y - start.y) ** 2) ** 0.5
            self.receive(WHEEL_ODOMETRY, WheelOdometry(value={"x_mm": 1000 * way}, timestamp=0.0))
        return super().latest(channel, max_age)


def test_the_first_script_is_what_pebble_script_new_writes() -> None:
    assert programs('"""Follow a tag') == [(ROOT / "pebble/extensions/scripts/commands/starter/run.py.txt").read_text()]


def test_a_loop_of_its_own_never_acts_on_what_is_old() -> None:
    robot = Driven(ROOT / "pebble/extensions/lab/simulation/world/room.json")
    start = robot.body.pose
    (text,) = programs('"""Drive half a metre')
    program = ModuleType("run")
    exec(compile(text, "docs/ext/scripts.md", "exec"), vars(program))
    robot.run(program.main, seconds=4.0)
    end = robot.body.pose
    assert ((end.x - start.x) ** 2 + (end.y - start.y) ** 2) ** 0.5 == pytest.approx(0.25, abs=0.06)
