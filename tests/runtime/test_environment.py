"""What the programs that a service starts find in their environment."""

from __future__ import annotations

import ast
import os
import subprocess
from pathlib import Path

import pytest

from pebble.runtime.environment import child_environment, withhold
from tests.support import ROOT

_STARTS = ("Popen", "run", "check_call", "check_output", "call")


def test_a_withheld_variable_is_empty_also_for_who_asks_for_no_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("UPLINK", "topsecret")
    withhold(["UPLINK", "NOT_SET"])
    assert child_environment()["UPLINK"] == ""
    assert subprocess.run(["printenv", "UPLINK"], capture_output=True, check=True).stdout == b"\n"
    assert "NOT_SET" not in os.environ


def test_the_launchers_variables_are_left_out_and_later_ones_win(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PEBBLE_NOTIFY_FD", "3")
    monkeypatch.setenv("MARK", "inherited")
    variables = child_environment({"MARK": "first"}, {"MARK": "second"})
    assert variables["MARK"] == "second"
    assert "PEBBLE_NOTIFY_FD" not in variables
    assert variables["PATH"] == os.environ["PATH"]


def test_every_service_that_starts_a_program_chooses_its_environment() -> None:
    starts = [
        (path, call)
        for path in (ROOT / "services").rglob("*.py")
        for call in ast.walk(ast.parse(path.read_text()))
        if isinstance(call, ast.Call) and ast.unparse(call.func) in {f"subprocess.{name}" for name in _STARTS}
    ]
    assert starts
    assert [_place(path, call) for path, call in starts if "env" not in {word.arg for word in call.keywords}] == []


def _place(path: Path, call: ast.Call) -> str:
    return f"{path.relative_to(ROOT)}:{call.lineno}"
