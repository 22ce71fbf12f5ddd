"""What the tests of one module share: a broker and a server; one browser, and whole robots.

Not for the whole session: while Playwright runs, asyncio.run fails in this process.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import pytest
from playwright.sync_api import Browser

from tests.support import Broker
from tests.web.browser import chromium
from tests.web.canned import CannedServer, Show, serving, showing
from tests.web.console import Console, Wire, console, used
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
def server() -> Iterator[CannedServer]:
    """It shows what ``show`` is given."""
    with serving() as running:
        yield running


@pytest.fixture(scope="module")
def show(server: CannedServer, browser: Browser) -> Show:
    """Opens the page in a state: ``with show(state, size, …) as opened``."""
    return partial(showing, server, browser)


@pytest.fixture(scope="module")
def robot_names() -> tuple[str, ...]:
    """The robots of ``stage``; none: the demo's four. A module that needs fewer has a fixture of its own."""
    return ()


@pytest.fixture(scope="module")
def stage(robot_names: tuple[str, ...]) -> Iterator[Stage]:
    """Whole robots: MiniLAMP alone is ready in a second."""
    with Stage(*robot_names, room=False) as running:
        yield running


@pytest.fixture(scope="module")
def wire(stage: Stage) -> Iterator[Wire]:
    running = Wire(stage)
    yield running
    running.close()


@pytest.fixture(scope="module")
def lamp_page(browser: Browser, stage: Stage) -> Iterator[Console]:
    with console(browser, stage, "minilamp") as opened:
        yield opened


@pytest.fixture
def at_lamp(lamp_page: Console) -> Iterator[Console]:
    """Minilamp's page: it has no camera, so it is ready at once."""
    with used(lamp_page) as ready:
        yield ready
