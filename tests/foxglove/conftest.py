"""A broker for each test, and requests that are withdrawn soon after the last client has left."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from pebble.client.media_request import request
from tests.support import Broker


@pytest.fixture(autouse=True)
def _short_linger(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(request, "LINGER_S", 0.4)


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    broker = Broker(tmp_path)
    yield broker
    broker.stop()
