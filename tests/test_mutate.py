"""The mutation tool, on a made module with a made test."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from tests.support import ROOT

MODULE = """
LIMIT = 3


def is_high(value):
    return value > LIMIT


def is_unused(value):
    return not value
"""
TEST = """
from made import limits


def test_limits():
    assert limits.is_high(4)
    assert not limits.is_high(2)
"""
EXPECTED = {
    "<module>:constant:1": "killed",
    "is_high:compare:1": "survived",
    "is_high:return:1": "killed",
    "is_unused:not:1": "not reached",
    "is_unused:return:1": "not reached",
}


def mutate(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command = [sys.executable, str(ROOT / "tools" / "mutate.py"), *arguments]
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=False, timeout=100
    )


def results(folder: Path, module: str, test: str, out: str) -> dict[str, str]:
    """Try all mutants of a module with one test; return the result of each by its name."""
    for name, text in {"made/limits.py": module, "tests/test_limits.py": test}.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).with_name("__init__.py").touch()
        (folder / name).write_text(text)
    done = mutate(folder, "made/limits.py", "--n", "0", "--out", out)
    assert done.returncode == 0, done.stdout + done.stderr
    records = map(json.loads, (folder / out).read_text().splitlines())
    return {record["name"].removeprefix("made/limits.py:"): record["result"] for record in records}


def test_it_finds_what_a_test_does_not_assert(tmp_path: Path) -> None:
    before = results(tmp_path, MODULE, TEST, "before")
    assert EXPECTED.items() <= before.items()
    assert results(tmp_path, f"import math\n\n{MODULE}", TEST, "moved") == before
    compared = mutate(tmp_path, "--compare", "before", "moved")
    assert (compared.returncode, compared.stdout) == (0, "")

    results(tmp_path, MODULE, TEST.replace("assert limits", "limits"), "spoilt")
    compared = mutate(tmp_path, "--compare", "before", "spoilt")
    assert compared.returncode == 1
    assert "is_high:return:1" in compared.stdout
