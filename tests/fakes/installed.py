"""Installs a fake program where programs are looked for, under the name of the real one."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from tests.support import ROOT, WAIT_S, until

_STARTS = "FAKE_STARTS"  # a file with the process id of every start


class Installed:
    """A program called ``name`` that runs ``python -m module``, found before any other of that name."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, folder: Path, name: str, module: str) -> None:
        self._starts = folder / f"{name}.starts"
        bin_ = folder / "bin"
        bin_.mkdir(exist_ok=True)
        script = bin_ / name
        variables = f'PYTHONPATH="{ROOT}" {_STARTS}="{self._starts}"'
        script.write_text(f'#!/bin/sh\nexport {variables}\nexec "{sys.executable}" -m {module} "$@"\n')
        script.chmod(0o755)
        monkeypatch.setenv("PATH", f"{bin_}:/usr/bin:/bin")

    @property
    def pids(self) -> list[int]:
        """Process ids of all its starts, in order."""
        return [int(line) for line in self._starts.read_text().split()] if self._starts.exists() else []

    def gone(self, pid: int, timeout: float = WAIT_S) -> bool:
        """True if this process has ended and was reaped."""
        return until(lambda: not Path(f"/proc/{pid}").exists(), timeout)


def signed_in() -> None:
    """Note the start of a fake program, which calls this."""
    with Path(os.environ[_STARTS]).open("a") as starts:
        starts.write(f"{os.getpid()}\n")
