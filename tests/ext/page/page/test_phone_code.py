"""The code that phones scan: on the page, read by OpenCV; none for an address that no phone can open."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tests.ext.page.browser import Tab, answer
from tests.ext.page.canned import CannedServer, Show
from tests.ext.page.states import GOOB_PATH, STATES

pytestmark = pytest.mark.page


def _read(opened: Tab) -> str:
    """Return what the code says, as it is shown."""
    picture = cv2.imdecode(np.frombuffer(opened.page.locator(".qr").screenshot(), np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    text, _, _ = cv2.QRCodeDetector().detectAndDecode(picture)
    return str(text)


def test_the_code_has_the_address_of_this_screen_and_none_that_no_phone_can_open(
    show: Show, server: CannedServer
) -> None:
    with show(STATES["fleet"]) as opened:
        opened.test("fleet-more").click()
        opened.test("phone").click()
        assert opened.until(lambda: opened.test("only-here").count() == 1)
        assert f"A phone cannot open 127.0.0.1:{server.port}" in opened.test("only-here").inner_text()
        assert opened.page.locator(".qr").count() == 0
        assert opened.complaints() == []
    module = server.static.files["core/browser-more.js"].decode()
    anywhere = module.replace("isLoopback =", "isLoopback = () => false, _isLoopback =")
    with show(STATES["driving"], theme="dark", routes={"**/core/browser-more.js": answer(anywhere)}) as opened:
        opened.page.locator("[data-test=settings]").click()
        opened.test("open-phone").click()
        assert opened.until(lambda: opened.page.locator(".qr").count() == 1)
        assert _read(opened) == server.url + GOOB_PATH
        opened.page.evaluate("() => pebble.route.go('')")
        assert opened.until(lambda: _read(opened) == f"{server.url}/", 3)
        assert opened.complaints() == []
