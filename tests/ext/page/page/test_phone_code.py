"""The code that phones scan: on the page, read by OpenCV; none for an address that no phone can open."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
import pytest
from playwright.sync_api import Browser

from tests.ext.page.browser import Tab, chromium, tab
from tests.ext.page.canned import CannedServer, serving
from tests.ext.page.states import GOOB_PATH, STATES

pytestmark = pytest.mark.page

HOST = "lab-pc.test"


@pytest.fixture(scope="module")
def browser(browser: Browser) -> Iterator[Browser]:
    """It believes that this machine has a name in the network."""
    with chromium(f"--host-resolver-rules=MAP {HOST} 127.0.0.1", beside=browser) as running:
        yield running


@pytest.fixture(scope="module")
def canned() -> Iterator[CannedServer]:
    with serving(STATES["driving"]) as running:
        yield running


def _read(opened: Tab) -> str:
    """What the code says, as it is shown."""
    picture = cv2.imdecode(np.frombuffer(opened.page.locator(".qr").screenshot(), np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    text, _, _ = cv2.QRCodeDetector().detectAndDecode(picture)
    return str(text)


def test_the_code_has_the_address_of_this_screen_and_none_that_no_phone_can_open(
    browser: Browser, canned: CannedServer
) -> None:
    origin = f"http://{HOST}:{canned.port}"
    with tab(browser, f"{origin}{GOOB_PATH}?watch", theme="dark") as opened:
        opened.page.locator("[data-test=settings]").click()
        opened.test("open-phone").click()
        assert opened.until(lambda: opened.page.locator(".qr").count() == 1)
        assert _read(opened) == origin + GOOB_PATH
        opened.page.evaluate("() => pebble.route.go('')")
        assert opened.until(lambda: _read(opened) == f"{origin}/", 3)
        assert opened.complaints() == []
    with tab(browser, canned.url) as opened:
        opened.test("fleet-more").click()
        opened.test("phone").click()
        assert opened.until(lambda: opened.test("only-here").count() == 1)
        assert f"A phone cannot open 127.0.0.1:{canned.port}" in opened.test("only-here").inner_text()
        assert opened.page.locator(".qr").count() == 0
        assert opened.complaints() == []
