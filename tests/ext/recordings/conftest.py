"""The fixture of tests that run commands."""

from __future__ import annotations

import pytest

from tests.commands.command_line import Run


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    return Run(monkeypatch, capsys)
