"""What tests of setup share: a scratch root, and the command line inside this process, at that root."""

from __future__ import annotations

from pathlib import Path

import pytest

from pebble.extensions.install.commands import setup as command
from pebble.extensions.install.setup import system
from pebble.extensions.operator.places import Places
from tests.commands.command_line import Run
from tests.ext.install.setup.rig import machine, machine_root


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return machine_root(tmp_path)


@pytest.fixture
def run(root: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    at(root, monkeypatch)
    return Run(monkeypatch, capsys)


def at(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the command act on this machine."""
    monkeypatch.setattr(system, "System", lambda: machine(root))
    monkeypatch.setattr(command, "Places", lambda: Places(root))
