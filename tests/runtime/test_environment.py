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


def test_the_launchers_variables_are_left_out_withheld_ones_are_empty_and_later_ones_win(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name, value in (("UPLINK", "topsecret"), ("PEBBLE_NOTIFY_FD", "3"), ("MARK", "inherited")):
        monkeypatch.setenv(name, value)
    withhold(["UPLINK", "NOT_SET"])
    variables = child_environment({"MARK": "first"}, {"MARK": "second"})
    assert (variables["MARK"], variables["UPLINK"], variables["PATH"]) == ("second", "", os.environ["PATH"])
    assert "PEBBLE_NOTIFY_FD" not in variables
    assert subprocess.run(["printenv", "UPLINK"], capture_output=True, check=True).stdout == b"\n"
    assert "NOT_SET" not in os.environ


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
