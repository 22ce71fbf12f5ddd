"""The page looks as it did: pictures of a few states are those in the folder looks (``make long PART=looks``)."""

from __future__ import annotations

import pytest
from playwright.sync_api import Browser

from tests.ext.page.canned import CannedServer
from tests.ext.page.looks import LOOKS, check, taken

pytestmark = [pytest.mark.page, pytest.mark.timeout(180)]


@pytest.mark.parametrize("name", LOOKS)
def test_a_state_looks_as_it_is_stored(server: CannedServer, browser: Browser, name: str) -> None:
    check(name, taken(server, browser, LOOKS[name]))
