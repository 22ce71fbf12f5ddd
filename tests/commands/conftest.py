"""What tests of commands share: a command line inside the process, and a broker for each module."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.commands.command_line import Run
from tests.support import Broker


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    return Run(monkeypatch, capsys)


@pytest.fixture(scope="module")
def broker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Broker]:
    running = Broker(tmp_path_factory.mktemp("broker"))
    yield running
    running.stop()
