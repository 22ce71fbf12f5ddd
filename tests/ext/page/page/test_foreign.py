"""What browsers deny to a page: in Chromium, on states given as data."""

from __future__ import annotations

import pytest

from tests.ext.page.canned import CannedServer, Show
from tests.ext.page.states import STATES

_DENY = """for (const [owner, names] of [%s]) for (const name of names.split(" "))
  Object.defineProperty(owner, name, { configurable: true, %s });"""
_THROWS = "get() { throw new DOMException('denied', 'SecurityError'); }"
_GONE = "value: undefined"
_STORES = "[window, 'sessionStorage localStorage']"
_OTHERS = """[navigator, 'getGamepads wakeLock clipboard mediaDevices keyboard userAgent'],
  [crypto, 'getRandomValues'], [screen, 'orientation'], [document, 'fullscreenElement fullscreenEnabled'],
  [Element.prototype, 'requestFullscreen setPointerCapture'],
  [window, 'matchMedia Worker ResizeObserver IntersectionObserver DecompressionStream createImageBitmap'],
  [window, 'AudioContext AudioWorkletNode AudioDecoder VideoDecoder OffscreenCanvas']"""
DENIED = {
    "stores throw": _DENY % (_STORES, _THROWS),
    "there are no stores": _DENY % (_STORES, _GONE),
    "stores are full": "Storage.prototype.setItem = () => { throw new DOMException('full', 'QuotaExceededError'); };",
    "stores forget": "Storage.prototype.setItem = () => {};",
    "all else throws": _DENY % (_OTHERS, _THROWS),
    "all else is missing": _DENY % (_OTHERS, _GONE),
    "everything throws": _DENY % (f"{_STORES}, {_OTHERS}", _THROWS),
}
_WORDS = "(document.body?.innerText ?? '')"
_RARE = pytest.mark.page


@pytest.mark.parametrize(
    "denied", [one if one == "everything throws" else pytest.param(one, marks=_RARE) for one in DENIED]
)
def test_what_a_browser_denies_keeps_no_page_from_its_server(show: Show, server: CannedServer, denied: str) -> None:
    with show(STATES["driving"], script=DENIED[denied]) as opened:
        assert opened.until(f"{_WORDS}.includes('online')"), opened.page.evaluate(_WORDS)
        assert opened.until("window.pebble.driver.pads !== null")  # all of the rest is there, too
        opened.page.keyboard.press("Control+Space")
        assert opened.until(lambda: any(op.get("op") == "estop" for op in server.received))
        assert opened.errors == []


@pytest.mark.parametrize(
    "how",
    [
        pytest.param(_THROWS, marks=_RARE),
        pytest.param(_GONE, marks=_RARE),
        "value: function () { throw new DOMException('denied', 'SecurityError'); }",
    ],
)
def test_without_sockets_the_page_has_no_connection_and_stops_by_a_request(
    show: Show, server: CannedServer, how: str
) -> None:
    script = _DENY % ("[window, 'WebSocket']", how)
    with show(STATES["driving"], script=script) as opened:
        assert opened.until(f"{_WORDS}.includes('No connection to the server')")
        opened.page.keyboard.press("Control+Space")
        assert opened.until(lambda: any(name == "estop" for name, _ in server.posted))
        assert opened.errors == []
