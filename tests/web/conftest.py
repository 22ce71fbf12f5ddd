"""What the tests of one module share: a broker and a server; one browser, and whole robots.

Not for the whole session: while Playwright runs, asyncio.run fails in this process.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser

from tests.support import Broker
from tests.web.browser import chromium
from tests.web.served import Served
from tests.web.stage import Stage


@pytest.fixture(scope="module")
def broker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Broker]:
    running = Broker(tmp_path_factory.mktemp("broker"))
    yield running
    running.stop()


@pytest.fixture(scope="module")
def served(broker: Broker) -> Iterator[Served]:
    with Served(broker.port) as running:
        yield running


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as running:
        yield running


@pytest.fixture(scope="module")
def stage() -> Iterator[Stage]:
    """The demo's four robots."""
    with Stage() as running:
        yield running


@pytest.fixture(scope="module")
def lamp() -> Iterator[Stage]:
    """MiniLAMP alone: ready in a second."""
    with Stage("minilamp") as running:
        yield running
