"""reboot, service-restart, git-pull: one table, three rows, and what keeps them from running too often."""

from __future__ import annotations

import logging
import sys
import threading
import time
from pathlib import Path

import pytest

from pebble.config import SystemControl
from pebble.contract import CHANNELS, GIT_PULL, REBOOT, Channel, Kind
from pebble.services.mqtt_bridge.requests.actions import ACTIONS, Action, Row, system_actions
from tests.services.mqtt_bridge.bridge_rig import make_config
from tests.support import until


class Clock:
    """Monotonic seconds, as a machine that has just been switched on counts them."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def row(channel: Channel, cooldown_s: float = 0.0) -> Row:
    return Row(channel, "", cooldown_s)


def control(code: str) -> SystemControl:
    return SystemControl(command=(sys.executable, "-c", code))


def finished(action: Action) -> bool:
    return until(lambda: not action.running)


def test_the_table_has_a_row_for_every_action_of_the_contract() -> None:
    assert {row.channel for row in ACTIONS} == {channel for channel in CHANNELS if channel.kind is Kind.ACTION}


def test_the_cooldowns() -> None:
    assert [(row.section, row.cooldown_s) for row in ACTIONS] == [
        ("reboot_control", 30), ("service_restart_control", 10), ("git_pull_control", 60)
    ]  # fmt: skip


def test_a_cooldown_begins_with_the_first_run_and_not_with_the_machine(tmp_path: Path) -> None:
    clock = Clock()
    action = Action(row(REBOOT, 30.0), control("pass"), folder=tmp_path, clock=clock)
    assert action.request()
    assert finished(action)
    clock.now = 29.9
    assert not action.request()
    clock.now = 30.0
    assert action.request()
    assert finished(action)


def test_refused_while_it_runs(tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    code = f"import os\nwhile not os.path.exists({str(gate)!r}): pass"
    action = Action(row(GIT_PULL), control(code), folder=tmp_path, clock=Clock())
    assert action.request()
    assert not action.request()
    gate.touch()
    assert finished(action)
    assert action.request()
    assert finished(action)


def test_runs_without_a_shell_in_its_folder_with_its_environment(tmp_path: Path) -> None:
    code = "import os, sys; open('said', 'w').write(os.environ['MARK'] + sys.argv[1])"
    words = (sys.executable, "-c", code, "; touch oops $MARK")
    as_configured = SystemControl(command=words, cwd=tmp_path, env={"MARK": "m"})
    action = Action(row(GIT_PULL), as_configured, folder=tmp_path, clock=Clock())
    assert action.request()
    assert finished(action)
    assert (tmp_path / "said").read_text() == "m; touch oops $MARK"
    assert not (tmp_path / "oops").exists()


def test_its_words_and_its_output_stay_in_a_file_on_the_robot(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    code = "import sys; print('pulls from https://deploy:ghp_TOKEN@git.example'); sys.exit(3)"
    action = Action(row(GIT_PULL), control(code), folder=tmp_path / "state", clock=Clock())
    assert action.request()
    output = tmp_path / "state" / "git-pull.log"
    assert until(lambda: f"flags/git-pull ended with exit code 3, its output is in {output}" in caplog.messages)
    assert "TOKEN" not in caplog.text
    assert output.read_text() == "pulls from https://deploy:ghp_TOKEN@git.example\n"
    assert output.stat().st_mode & 0o777 == 0o600


def test_the_file_of_a_command_that_floods_stays_small_and_has_its_last_words(tmp_path: Path) -> None:
    code = "import sys, time; print('y' * 3_000_000, flush=True); time.sleep(0.6); sys.exit('fatal')"
    action = Action(row(GIT_PULL), control(code), folder=tmp_path, clock=Clock())
    assert action.request()
    assert finished(action)
    text = (tmp_path / "git-pull.log").read_text()
    assert (len(text) < 100_000, text[:8], text[-6:]) == (True, "(2934465", "fatal\n")


def test_its_end_is_logged_whatever_it_leaves_behind(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    code = "import subprocess; subprocess.Popen(['sleep', '10'])"
    assert Action(row(GIT_PULL), control(code), folder=tmp_path, clock=Clock()).request()
    assert until(lambda: "git-pull ended with exit code 0" in caplog.text)


def test_runs_also_where_no_file_can_be_written(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    (tmp_path / "state").touch()  # a file where the folder is expected
    action = Action(row(GIT_PULL), control("print('done')"), folder=tmp_path / "state", clock=Clock())
    assert action.request()
    assert until(lambda: "git-pull ended with exit code 0, its output is lost: File exists: " in caplog.text)


def test_a_missing_command_is_one_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    action = Action(row(REBOOT), SystemControl(), folder=tmp_path, clock=Clock())
    assert [action.request() for _ in range(5)] == [False] * 5
    assert len([record for record in caplog.records if record.levelno == logging.WARNING]) == 1


def test_a_program_that_is_not_there_is_an_error_that_does_not_quote_it(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    action = Action(row(REBOOT), SystemControl(command=("/no/such/TOKEN",)), folder=tmp_path, clock=Clock())
    assert not action.request()
    assert "reboot failed: its command or cwd: No such file or directory" in caplog.text
    assert "TOKEN" not in caplog.text


@pytest.mark.parametrize("command", [(sys.executable, "-c", "input()"), ("/no/such/program",)])
def test_a_flood_of_requests_is_a_few_lines_of_the_log(
    command: tuple[str, ...], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    controls = {row.section: {"command": list(command), "cwd": str(tmp_path)} for row in ACTIONS}
    actions = system_actions(make_config(**controls).services.mqtt_bridge, tmp_path, time.monotonic)
    threads, before = threading.active_count(), time.monotonic()
    for _ in range(40):
        for row in ACTIONS:
            actions[row.channel].request()
    assert until(lambda: threading.active_count() == threads)
    assert len(caplog.records) <= 10 * max(1.0, time.monotonic() - before)
