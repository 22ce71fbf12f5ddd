"""What the tests of one module share: a broker and a server, one browser, and pages in given states.

Not for the whole session: while Playwright runs, asyncio.run fails in this process.
"""

import itertools
from collections.abc import Iterator
from functools import partial

import pytest
from playwright.sync_api import Browser

from tests.commands.conftest import broker as broker
from tests.ext.page.browser import chromium
from tests.ext.page.canned import CannedServer, Show, serving, showing
from tests.ext.page.served import Page, Served
from tests.kit.played_robot import RecordingRobot
from tests.support import Broker

_NUMBERS = itertools.count(1)


@pytest.fixture(scope="module")
def served(broker: Broker) -> Iterator[Served]:
    with Served(broker.port) as running:
        yield running


@pytest.fixture
def robot(broker: Broker) -> Iterator[RecordingRobot]:
    """Another one for each test."""
    with RecordingRobot(broker.port, f"pebble/robots/robot{next(_NUMBERS)}") as one:
        yield one


@pytest.fixture
def page(served: Served, robot: RecordingRobot) -> Iterator[Page]:
    """It can drive the robot, once it has asked for control."""
    with served.page() as one:
        assert one.knows(robot.base)
        assert one.ready()
        yield one


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
