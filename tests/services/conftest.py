"""The two brokers around a program under test."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support import Broker


@pytest.fixture(scope="module")
def local(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Broker]:
    """The robot's own."""
    broker = Broker(tmp_path_factory.mktemp("local"))
    yield broker
    broker.stop()


@pytest.fixture
def remote(tmp_path: Path) -> Iterator[Broker]:
    """The operators'."""
    broker = Broker(tmp_path)
    yield broker
    broker.stop()
