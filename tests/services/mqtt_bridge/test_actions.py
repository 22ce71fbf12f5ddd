"""reboot, service-restart, git-pull: one table, three rows, and what keeps them from running too often."""

from __future__ import annotations

import logging
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

from pebble.config import SystemControl
from pebble.contract import CHANNELS, Kind
from pebble.services.mqtt_bridge.actions import ACTIONS, Action, SystemActions
from tests.services.mqtt_bridge.bridge_rig import make_config
from tests.support import until


class Clock:
    """Monotonic seconds, as a machine that has just been switched on counts them."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def control(code: str, **more: Any) -> SystemControl:
    return SystemControl(command=(sys.executable, "-c", code), **more)


def finished(action: Action) -> bool:
    return until(lambda: action._process is not None and action._process.poll() is not None)


def test_the_table_has_a_row_for_every_action_of_the_contract() -> None:
    assert {row.channel for row in ACTIONS} == {channel for channel in CHANNELS if channel.kind is Kind.ACTION}


@pytest.mark.parametrize(
    ("section", "cooldown_s"), [("reboot_control", 30), ("service_restart_control", 10), ("git_pull_control", 60)]
)
def test_cooldowns_unless_configured(section: str, cooldown_s: float) -> None:
    assert getattr(make_config().services.mqtt_bridge, section).cooldown_seconds == cooldown_s


def test_a_cooldown_begins_with_the_first_run_and_not_with_the_machine() -> None:
    clock = Clock()
    action = Action("reboot", control("pass", cooldown_seconds=30), clock=clock)
    assert action.request()
    assert finished(action)
    clock.now = 29.9
    assert not action.request()
    clock.now = 30.0
    assert action.request()
    assert finished(action)


def test_zero_is_a_cooldown() -> None:
    action = Action("reboot", control("pass", cooldown_seconds=0.0), clock=Clock())
    for _ in range(3):
        assert action.request()
        assert finished(action)


def test_refused_while_it_runs(tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    action = Action("git-pull", control(f"import os\nwhile not os.path.exists({str(gate)!r}): pass"), clock=Clock())
    assert action.request()
    assert not action.request()
    gate.touch()
    assert finished(action)
    assert action.request()
    assert finished(action)


def test_runs_without_a_shell_in_its_folder_with_its_environment(tmp_path: Path) -> None:
    code = "import os, sys; open('said', 'w').write(os.environ['MARK'] + sys.argv[1])"
    words = (sys.executable, "-c", code, "; touch oops $MARK")
    action = Action("git-pull", SystemControl(command=words, cwd=tmp_path, env={"MARK": "m"}), clock=Clock())
    assert action.request()
    assert finished(action)
    assert (tmp_path / "said").read_text() == "m; touch oops $MARK"
    assert not (tmp_path / "oops").exists()


def test_a_line_of_text_is_split_as_a_shell_would(tmp_path: Path) -> None:
    section = {"git_pull_control": {"command": f'{sys.executable} -c \'open("made here", "w")\'', "cwd": str(tmp_path)}}
    actions = SystemActions(make_config(**section).services.mqtt_bridge)
    assert actions.request(next(row.channel for row in ACTIONS if row.section == "git_pull_control"))
    assert until(lambda: (tmp_path / "made here").exists())


def test_its_output_and_its_exit_code_are_logged(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    action = Action("git-pull", control("import sys; print('Already up to date.'); sys.exit(3)"), clock=Clock())
    assert action.request()
    assert until(lambda: "git-pull ended with exit code 3" in caplog.messages)
    assert "git-pull: Already up to date." in caplog.messages


def test_a_missing_command_is_one_warning(caplog: pytest.LogCaptureFixture) -> None:
    action = Action("reboot", SystemControl(), clock=Clock())
    assert [action.request() for _ in range(5)] == [False] * 5
    assert len([record for record in caplog.records if record.levelno == logging.WARNING]) == 1


def test_a_program_that_is_not_there_is_an_error_and_no_more(caplog: pytest.LogCaptureFixture) -> None:
    assert not Action("reboot", SystemControl(command=("/no/such/program",)), clock=Clock()).request()
    assert "reboot failed" in caplog.text


def test_leaves_no_thread_behind() -> None:
    before = threading.active_count()
    action = Action("reboot", control("pass"), clock=Clock())
    assert action.request()
    assert finished(action)
    assert until(lambda: threading.active_count() == before)
