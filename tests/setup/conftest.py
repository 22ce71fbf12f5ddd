"""What tests of setup share: a scratch root, a file of answers, and the command line inside this process."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.commands.command_line import Run
from tests.setup.rig import answers_in, machine_root


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return machine_root(tmp_path)


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    return Run(monkeypatch, capsys)


@pytest.fixture
def answers(tmp_path: Path) -> Path:
    return answers_in(tmp_path)
