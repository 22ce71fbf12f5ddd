"""Runs ``pebble`` command lines, inside this process or as processes of their own."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from pebble import cli
from tests.support import ROOT

GOOB = "pebble/robots/goob"


class Run:
    """One command line, run inside this process."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        self._monkeypatch, self._capsys = monkeypatch, capsys
        self.out = self.err = ""

    def __call__(self, *arguments: str | Path, columns: int = 80) -> int:
        self._monkeypatch.setattr(sys, "argv", ["pebble", *map(str, arguments)])
        self._monkeypatch.setenv("COLUMNS", str(columns))
        code = cli.main()
        self.out, self.err = self._capsys.readouterr()
        return code


def config_file(folder: Path, **changes: Any) -> Path:
    path = folder / "robot.json"
    path.write_text(json.dumps({"robot": {"id": "goob"}, **changes}))
    return path


def program(*arguments: str | Path, **options: Any) -> subprocess.Popen[str]:
    """One command line as a process of its own."""
    command = [sys.executable, "-m", "pebble.cli", *map(str, arguments)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "cwd": ROOT, **options}
    return subprocess.Popen(command, text=True, **pipes)


@contextmanager
def running(*arguments: str | Path, **options: Any) -> Iterator[subprocess.Popen[str]]:
    """The same, killed in the end if it has not ended by then."""
    with program(*arguments, **options) as process:
        try:
            yield process
        finally:
            process.kill()
