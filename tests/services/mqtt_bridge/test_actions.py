"""reboot, service-restart, git-pull: one table, three rows, and what keeps them from running too often."""

from __future__ import annotations

import logging
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pebble.config import SystemControl
from pebble.contract import CHANNELS, GIT_PULL, REBOOT, Kind
from pebble.services.mqtt_bridge.requests.actions import ACTIONS, Action, Row
from tests.support import Clock, until

PYTHON = (sys.executable, "-c")


@pytest.fixture
def make(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> Callable[..., Action]:
    caplog.set_level(logging.DEBUG)

    def action(*words: str, **options: Any) -> Action:
        return Action(Row(GIT_PULL, "", 0.0), SystemControl(command=words, **options), folder=tmp_path, clock=Clock())

    return action


def finished(action: Action) -> bool:
    assert action.request()
    return until(lambda: not action.running)


def test_the_table_has_a_row_for_every_action_of_the_contract_with_its_cooldown() -> None:
    assert {row.channel for row in ACTIONS} == {channel for channel in CHANNELS if channel.kind is Kind.ACTION}
    assert [(row.section, row.cooldown_s) for row in ACTIONS] == [
        ("reboot_control", 30), ("service_restart_control", 10), ("git_pull_control", 60)
    ]  # fmt: skip


def test_a_cooldown_begins_with_the_first_run_and_not_with_the_machine(tmp_path: Path) -> None:
    clock = Clock()
    clock.now = 0.0
    action = Action(Row(REBOOT, "", 30.0), SystemControl(command=(*PYTHON, "pass")), folder=tmp_path, clock=clock)
    assert finished(action)
    clock.now = 29.9
    assert not action.request()
    clock.now = 30.0
    assert finished(action)


def test_refused_while_it_runs(make: Callable[..., Action], tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    action = make(*PYTHON, f"import os\nwhile not os.path.exists({str(gate)!r}): pass")
    assert action.request()
    assert not action.request()
    follows = [thread.daemon for thread in threading.enumerate() if thread.name == f"action {action.name}"]
    assert follows == [True], "a bridge ends before the command that restarts it does"
    gate.touch()
    assert until(lambda: not action.running)
    assert finished(action)


def test_runs_without_a_shell_in_its_folder_with_its_environment(make: Callable[..., Action], tmp_path: Path) -> None:
    code = "import os, sys; open('said', 'w').write(os.environ['MARK'] + sys.argv[1])"
    assert finished(make(*PYTHON, code, "; touch oops $MARK", cwd=tmp_path, env={"MARK": "m"}))
    assert (tmp_path / "said").read_text() == "m; touch oops $MARK"
    assert not (tmp_path / "oops").exists()


def test_its_end_is_logged_without_its_words_and_its_output(
    make: Callable[..., Action], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Also if it leaves a process behind."""
    assert make(*PYTHON, "import subprocess; subprocess.Popen(['sleep', '10']); print('ghp_TOKEN'); exit(3)").request()
    assert until(lambda: "flags/git-pull ended with exit code 3, its output is in " in caplog.text)
    assert "TOKEN" not in caplog.text
    output = tmp_path / "git-pull.log"
    assert (output.read_text(), output.stat().st_mode & 0o777) == ("ghp_TOKEN\n", 0o600)


def test_the_file_of_a_command_that_floods_stays_small_and_has_its_last_words(
    make: Callable[..., Action], tmp_path: Path
) -> None:
    code = "import sys, time; print('y' * 3_000_000, flush=True); time.sleep(0.6); sys.exit('fatal')"
    assert finished(make(*PYTHON, code))
    text = (tmp_path / "git-pull.log").read_text()
    assert (len(text) < 100_000, text[:8], text[-6:]) == (True, "(2934465", "fatal\n")


def test_runs_also_where_no_file_can_be_written(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    (tmp_path / "state").touch()  # a file where the folder is expected
    words = SystemControl(command=(*PYTHON, "print('done')"))
    assert Action(Row(GIT_PULL, "", 0.0), words, folder=tmp_path / "state", clock=Clock()).request()
    assert until(lambda: "git-pull ended with exit code 0, its output is lost: File exists: " in caplog.text)


@pytest.mark.parametrize(
    ("words", "why"), [((), "has no command for it"), (("/no/such/TOKEN",), "its command or cwd: No such file or dir")]
)
def test_a_command_that_cannot_run_is_one_line_that_does_not_quote_it(
    make: Callable[..., Action], caplog: pytest.LogCaptureFixture, words: tuple[str, ...], why: str
) -> None:
    action = make(*words)
    assert [action.request() for _ in range(5)] == [False] * 5
    assert caplog.text.count(why) == 1
    assert "TOKEN" not in caplog.text
