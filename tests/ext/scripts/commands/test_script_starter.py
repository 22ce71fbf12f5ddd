"""What ``pebble script new`` writes works as it is, and its test would notice if it did not."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.commands.command_line import Run


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


def test_its_robot_is_one(folder: Path, run: Run) -> None:
    assert run("check", folder / "goob.json") == 0, run.err
    assert "autonomy_manager" in run.out


def test_an_existing_folder_is_left_alone(folder: Path, run: Run) -> None:
    assert run("script", "new", "follow-me", "--folder", folder.parent) == 1
    assert run.err == f"pebble: {folder} exists already: choose another name, or another --folder\n"


@pytest.mark.parametrize("name", ["../out", "1st", "x" * 80])
def test_a_name_that_no_module_could_have_is_refused(name: str, run: Run, tmp_path: Path) -> None:
    assert run("script", "new", name, "--folder", tmp_path) == 1
    assert run.err.startswith(f"pebble: {name!r}: a script's name is letters, digits, - and _")
