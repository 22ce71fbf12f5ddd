"""What all modules here share: robots on microcontrollers, which are ready within two seconds."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser

from tests.ext.page.attacker import Everything
from tests.ext.page.console import Console, console, used
from tests.ext.page.stage import Stage


@pytest.fixture(scope="package")
def stage() -> Iterator[Stage]:
    with Stage("minilamp", "benjr") as running:
        yield running


@pytest.fixture(scope="module")
def wire(stage: Stage) -> Iterator[Everything]:
    running = Everything(stage.broker_port)
    yield running
    running.close()


@pytest.fixture(scope="module")
def lamp_page(browser: Browser, stage: Stage) -> Iterator[Console]:
    with console(browser, stage, "minilamp", engineers=False) as opened:
        yield opened


@pytest.fixture
def at_lamp(lamp_page: Console) -> Iterator[Console]:
    """Minilamp's page: it has no camera, so it is ready at once."""
    with used(lamp_page) as ready:
        yield ready
