"""Fixtures of the tests with a browser: one browser, and whole robots, for each module that asks for them.

Not for the whole session: while Playwright runs, asyncio.run fails in this process.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser

from tests.web.browser import chromium
from tests.web.stage import Stage


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
