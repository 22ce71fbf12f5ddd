"""What browsers deny and what their extensions do to a page: in Chromium, on states given as data."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress

import pytest
from playwright.sync_api import Error, Page

from tests.web.browser import Tab
from tests.web.canned import CannedServer, Show
from tests.web.states import GOOB, STATES, driver, estop

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
_TEXTS = """const texts = [];
for (const walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT); walk.nextNode(); ) {
  const { data, parentElement } = walk.currentNode;
  if (data.trim() && !parentElement.closest("svg, select")) texts.push(walk.currentNode);
}
const all = (selector) => document.querySelectorAll(selector);
const made = (name, ...children) => {
  const one = Object.assign(document.createElement(name), { className: "foreign" });
  one.append(...children);
  return one;
};
const wrap = (one, name) => { const to = made(name); one.replaceWith(to); to.append(one); };"""
_PARTS = "'.chip, .banners > *, .why-line'"
#: What translators, grammar checkers and other extensions do with a page; none asks for ``translate="no"``.
CHANGES = {
    "texts go into new elements": "for (const one of texts) one.replaceWith(made('font', made('font', one.data)));",
    "texts are moved into new elements": "for (const one of texts) wrap(one, 'font');",
    "texts are written anew": "for (const one of texts) one.data = one.data.toUpperCase();",
    "texts are split": "for (const one of texts) if (one.length > 2) one.splitText(2);",
    "texts are joined": "for (const one of texts) one.parentElement?.normalize();",
    "texts are taken away": "for (const one of texts) one.remove();",
    "elements lose what is in them": "for (const one of all('.top *, .why-line *, .banners *')) one.textContent = '';",
    "elements change places": "for (const one of all('.top, .vital')) one.append(...[...one.childNodes].reverse());",
    "elements are wrapped": f"for (const one of all({_PARTS})) wrap(one, 'div');",
    "elements are taken away": f"for (const one of all({_PARTS})) one.remove();",
    "elements of others come between": "for (const one of all('#app *:not(svg, svg *)')) one.prepend(made('b', 'no'));",
    "all is taken away": "document.getElementById('app').replaceChildren();",
    "the page is taken away": "document.getElementById('app').remove();",
    "the page is copied": "const app = document.getElementById('app'); app.replaceWith(app.cloneNode(true));",
    "all is written anew": "document.body.innerHTML = document.body.innerHTML + '';",
    "the body is another": "document.body.replaceWith(made('body', 'to be read'));",
    "the body is taken away": "document.body.remove();",
}
_SET = """([ref, driver, estop]) => {
  pebble.store.set(ref, "web/driver", driver);
  pebble.store.set(ref, "web/estop", estop);
}"""
_MINE = [GOOB, driver("alice", you=True), estop(0)]
_LATER = [GOOB, driver("zoe"), estop(0, "zoe")]
_WORDS = "(document.body?.innerText ?? '')"
_RARE = pytest.mark.page


@pytest.fixture(scope="module")
def driving(show: Show) -> Iterator[Tab]:
    with show(STATES["driving"]) as opened:
        assert opened.until(f"{_WORDS}.includes('You drive') && pebble.driver.pads !== null")
        yield opened


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


@_RARE
@pytest.mark.parametrize("change", CHANGES)
def test_state_is_shown_whatever_others_do_to_the_page(driving: Tab, change: str) -> None:
    driving.page.evaluate(_SET, _MINE)
    assert driving.until(f"{_WORDS}.includes('You drive') && !{_WORDS}.includes('is stopped')")
    driving.page.evaluate(f"() => {{ {_TEXTS} {CHANGES[change]} }}")
    driving.page.evaluate(_SET, _LATER)
    later = f"/is stopped\\s+by zoe/.test({_WORDS}) && !{_WORDS}.includes('You drive')"
    assert driving.until(later), driving.page.evaluate(_WORDS)
    foreign = "document.querySelector(':is(header, .banners, .why-line) .foreign')"
    assert driving.until(f"!{foreign}")
    assert driving.errors == []


@_RARE
@pytest.mark.parametrize(
    "change",
    [
        "document.documentElement.replaceWith(document.createElement('html'))",
        "document.write('<p>to be read</p>')",
    ],
)
def test_a_page_whose_document_was_replaced_is_loaded_again(show: Show, server: CannedServer, change: str) -> None:
    """What listened to keys and buttons may have gone with it."""
    with show(STATES["driving"]) as opened:
        assert opened.until("window.pebble?.driver.pads != null")
        with suppress(Error):  # it is gone before it can answer
            opened.page.evaluate(f"() => {{ pebble.old = true; {change}; }}")
        assert opened.until(lambda: _is_new(opened.page))
        opened.page.keyboard.press("Control+Space")
        assert opened.until(lambda: any(op.get("op") == "estop" for op in server.received))


def _is_new(page: Page) -> bool:
    with suppress(Error):  # it is being loaded
        return bool(page.evaluate("window.pebble?.old !== true && window.pebble?.connection.isOpen"))
    return False


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
