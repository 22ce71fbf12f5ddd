"""What Tab completes in a real bash, with the script that packages install."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support import ROOT

BASH = ROOT / "configs" / "completion" / "pebble"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with the configs of two robots, one of which has a script, and with files that are no configs."""
    for name, robot in (("hall.json", {"id": "goob"}), ("lamp.json", {"id": "minilamp"})):
        (tmp_path / name).write_text(json.dumps({"robot": robot}))
    for name, text in (("broken.json", "{"), ("list.json", "[]"), ("notes.txt", "")):
        (tmp_path / name).write_text(text)
    (tmp_path / "autonomy" / "dance").mkdir(parents=True)
    (tmp_path / "autonomy" / "dance" / "run.py").touch()
    (tmp_path / "bin").mkdir()
    program = tmp_path / "bin" / "pebble"
    program.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m pebble.cli "$@"\n')
    program.chmod(0o755)
    return tmp_path


def bash(folder: Path, line: str) -> list[str]:
    """What a bash offers for the last word of a line."""
    words = line.split(" ")
    asked = f"COMP_WORDS=({shlex.join(words)}); COMP_CWORD={len(words) - 1}; _pebble_completion pebble"
    script = f'source {BASH}; {asked}; printf "%s\\n" "${{COMPREPLY[@]}}"'
    command = ["bash", "--norc", "-c", script]
    env = {**os.environ, "PATH": f"{folder / 'bin'}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, timeout=60)
    assert done.stderr == ""
    return done.stdout.split()


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("pebble up h", ["hall.json"]),
        ("pebble up notes", []),
        ("pebble drive goo", ["goob"]),
        ("pebble topic echo online -r goo", ["goob"]),
        ("pebble script start hall.json da", ["dance"]),
        ("pebble script start goob whe", ["wheel-odometry"]),
    ],
)
def test_bash_completes_a_word(folder: Path, line: str, offered: list[str]) -> None:
    assert bash(folder, line) == offered
