"""A robot with one medium and the server's hubs, on the event loop of the test."""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Any

import pytest

from pebble.extensions.operator.client.media_request import shared
from tests.ext.page.media.robots import MediaRobot, Server, serving


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture(autouse=True)
def _short_linger(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shared, "LINGER_S", 0.4)


@pytest.fixture
async def server(robot: MediaRobot, anyio_backend: Any) -> AsyncIterator[Server]:
    async with serving(robot) as one:
        yield one
