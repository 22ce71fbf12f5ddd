"""A page can always stop robots: without one of its files, where a browser denies it something, and by its keys."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable
from dataclasses import replace

import pytest
from playwright.sync_api import Browser, Route

from tests.ext.page.browser import Tab, tab
from tests.ext.page.canned import CannedServer, Show
from tests.ext.page.served import Served
from tests.ext.page.states import STATES
from tests.kit.played_robot import RecordingRobot
from tests.support import WAIT_S, some

Lose = Callable[[Route], object]


def lost_once(_: bytes, _kind: str) -> Lose:
    left = iter([True])
    return lambda route: route.abort() if next(left, False) else route.fallback()


_UNANSWERED: list[Route] = []  # until the page has stopped robots
#: What happens to a file of this content and kind each time that it is asked for.
FAULTS: dict[str, Callable[[bytes, str], Lose]] = {
    "lost once": lost_once,
    "lost for ever": lambda *_: lambda route: route.abort(),
    "cut off": lambda file, kind: lambda route: route.fulfill(body=file[: len(file) // 2], content_type=kind),
    "an error page": lambda *_: lambda route: route.fulfill(status=502, body="<h1>502 Bad Gateway</h1>"),
    "not answered": lambda *_: lambda route: _UNANSWERED.append(route),
}
#: Where files of some names are fetched: a few, and then all.
LOST = [
    ("fleet", "^(main.js|core/store.js|ui/fleet/doubt.js|app.css|fleet.css)$"),
    pytest.param("recordings", "replay", marks=pytest.mark.page),
    pytest.param("fleet", "fleet|many", marks=pytest.mark.page),
    pytest.param("full", "^(?!.*(replay|fleet|many|login))", marks=pytest.mark.page),
]
_SOON = "globalThis.pebbleWaitMs = 1500"
_PRESS = """() => setTimeout(() => {
  const form = document.querySelector("#start:not([hidden])");
  (form ?? document).querySelector(form ? "button" : "#app .stop").click();
})"""
#: Whether the page shows a STOP as large as a finger.
_SHOWS = """[...document.querySelectorAll("#app .stop, #start:not([hidden]) button")].some((stop) => {
  const { width, height } = stop.getBoundingClientRect();
  const { backgroundColor, borderTopColor } = getComputedStyle(stop);
  const ours = /179, 0, 27|168, 0, 25/;
  return width > 60 && height > 35 && (ours.test(backgroundColor) || ours.test(borderTopColor));
})"""
_WHOLE = "!document.querySelector('#start:not([hidden]), #app .failed, #app main .loading')"


def stopped(server: CannedServer) -> bool:
    """True if a stop has come, perhaps by a request: a name that was typed begins a new connection."""
    return bool(server.sent("estop") or server.posted)


@pytest.mark.timeout(1800)
@pytest.mark.parametrize(("state", "pattern"), LOST)
def test_a_page_that_loses_a_file_stops_robots(
    browser: Browser, server: CannedServer, state: str, pattern: str
) -> None:
    """Open a page for each file, which is lost in one of the ways, and press its STOP."""
    server.show(STATES[state])
    names = [name for name in server.static.files if re.search(pattern, name) and not name.endswith(".html")]
    for name, fault in zip(names, itertools.cycle(FAULTS), strict=False):
        server.received.clear()
        server.posted.clear()
        kind = "text/css" if name.endswith(".css") else "text/javascript"
        lost = {re.compile(f"/static/.*/{re.escape(name)}"): FAULTS[fault](server.static.files[name], kind)}
        with tab(browser, server.url + STATES[state].path, script=_SOON, here="commit", routes=lost) as opened:
            assert opened.until(_SHOWS), (name, fault)
            assert fault != "lost once" or opened.until(_WHOLE), name
            opened.page.wait_for_timeout(500)
            opened.page.evaluate(_PRESS)
            assert opened.until(lambda: stopped(server)), (name, fault)
            while _UNANSWERED:
                _UNANSWERED.pop().abort()
            opened.context.unroute_all(behavior="ignoreErrors")


def test_stop_is_red_from_the_first_where_people_choose_all_colours(browser: Browser, server: CannedServer) -> None:
    server.show(STATES["fleet"])
    later = {"**/panels.css": lambda route: route.abort(), "**/*.*/panels.css": lambda route: route.abort()}
    with tab(browser, server.url, routes=later, forced_colors="active") as opened:
        assert opened.until(_SHOWS)


def test_its_stop_is_a_form_that_the_server_takes(browser: Browser, served: Served, robot: RecordingRobot) -> None:
    lost = {"**/main.js": lambda route: route.abort(), "**/*.*/main.js": lambda route: route.abort()}
    with served.page() as other, tab(browser, served.origin, script=_SOON, routes=lost) as opened:
        assert other.knows(robot.base)
        assert opened.until(_SHOWS)
        opened.page.get_by_role("button", name="STOP ALL").click()
        assert opened.until(lambda: robot.latched)
        assert opened.until("document.body?.innerText.includes('Confirmed by')")
        assert opened.violations == []


# -- what a browser denies

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
_FULL = "Storage.prototype.setItem = () => { throw new DOMException('full', 'QuotaExceededError'); };"
_WORDS = "(document.body?.innerText ?? '')"


@pytest.mark.parametrize(
    "denied",
    [
        pytest.param(_DENY % (f"{_STORES}, {_OTHERS}", _THROWS), id="everything throws"),
        pytest.param(_DENY % (f"{_STORES}, {_OTHERS}", _GONE), id="everything is missing", marks=pytest.mark.page),
        pytest.param(_FULL, id="stores are full", marks=pytest.mark.page),
    ],
)
def test_what_a_browser_denies_keeps_no_page_from_its_server(show: Show, server: CannedServer, denied: str) -> None:
    with show(STATES["driving"], script=denied) as opened:
        assert opened.until(f"{_WORDS}.includes('online')"), opened.page.evaluate(_WORDS)
        assert opened.until("window.pebble.driver.pads !== null")  # all of the rest is there, too
        opened.page.keyboard.press("Control+Space")
        assert opened.until(lambda: any(op.get("op") == "estop" for op in server.received))
        assert opened.errors == []


def test_without_sockets_the_page_has_no_connection_and_stops_by_a_request(show: Show, server: CannedServer) -> None:
    denied = "value: function () { throw new DOMException('denied', 'SecurityError'); }"
    with show(STATES["driving"], script=_DENY % ("[window, 'WebSocket']", denied)) as opened:
        assert opened.until(f"{_WORDS}.includes('No connection to the server')")
        opened.page.keyboard.press("Control+Space")
        assert opened.until(lambda: any(name == "estop" for name, _ in server.posted))
        assert opened.errors == []


# -- keys, in every state in which a browser may take them for itself


def _full_screen(opened: Tab) -> None:
    opened.page.evaluate("document.documentElement.requestFullscreen()")
    assert opened.until("document.fullscreenElement !== null")


def _list(opened: Tab) -> None:
    opened.test("picker").click()
    assert opened.until("document.querySelector('select:open') !== null")


def _dialog(opened: Tab) -> None:
    opened.test("settings").click()
    assert opened.until("document.querySelector('dialog[open]') !== null")


def _composition(opened: Tab) -> None:
    _dialog(opened)
    opened.page.locator("dialog input[type=text]").click()
    opened.cdp().send("Input.imeSetComposition", {"text": "にほ", "selectionStart": 2, "selectionEnd": 2})


STATE = replace(STATES["free"], welcome={"login": False})
_OPEN = "globalThis.pebble?.connection?.isOpen"
_BUTTON = """document.querySelector("[aria-label='Leave full screen']")"""
WHERE: dict[str, Callable[[Tab], object]] = {
    "nothing": lambda _: None,
    "full screen": _full_screen,
    "an open list": _list,
    "a dialog": _dialog,
    "a composition": _composition,
    "another window": lambda opened: opened.blur(),
}
#: Keys, and whether they stop.
KEYS = {
    ("Escape",): False,
    ("Control+Enter",): True,
    ("Meta+Enter",): True,
    ("Control+Space",): True,
    ("Escape", "Escape"): True,
}
#: How often keys are pressed before the page sees them: an open list takes them, and Enter closes it.
TIMES = {("an open list", "Control+Enter"): 2, ("an open list", "Meta+Enter"): 2}
NEVER = ("an open list", ("Control+Space",))
ROWS = [row for row in itertools.product(WHERE, KEYS) if row != NEVER]


@pytest.mark.parametrize(("where", "keys"), some(ROWS, 4))
def test_keys_stop_and_one_escape_does_not(show: Show, server: CannedServer, where: str, keys: tuple[str, ...]) -> None:
    with show(STATE, when=_OPEN) as opened:
        WHERE[where](opened)
        for key in keys * TIMES.get((where, keys[0]), 1):
            opened.page.keyboard.press(key)
        assert opened.until(lambda: stopped(server), WAIT_S if KEYS[keys] else 0.8) is KEYS[keys]


@pytest.mark.parametrize(("leave", "stops"), [("document.exitFullscreen()", True), (f"{_BUTTON}.click()", False)])
def test_full_screen_that_the_page_did_not_end_is_an_escape(
    show: Show, server: CannedServer, leave: str, stops: bool
) -> None:
    """A browser leaves it by the first one, and shows the page no key."""
    with show(STATE, when=_OPEN) as opened:
        _full_screen(opened)
        assert opened.until(f"{_BUTTON} !== null")
        opened.page.evaluate(leave)
        assert opened.until("document.fullscreenElement === null")
        opened.page.keyboard.press("Escape")
        assert opened.until(lambda: stopped(server), WAIT_S if stops else 0.5) is stops
