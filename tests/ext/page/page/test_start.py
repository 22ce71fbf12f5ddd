"""A page that loses one of its files: what it shows, and that it can stop robots all the same."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterator

import pytest
from playwright.sync_api import Browser, Route

from tests.ext.page.browser import tab
from tests.ext.page.canned import CannedServer
from tests.ext.page.served import Served
from tests.ext.page.states import STATES
from tests.kit.played_robot import RecordingRobot

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
#: Of the start, fetched by that, fetched by the screen, looks, a worker.
SAMPLE = {
    "fleet": ("main.js", "core/store.js", "ui/fleet/doubt.js", "app.css", "fleet.css"),
    "full": ("ui/robot/robot.js", "media/decode.js"),
}
#: Where all files of some names are fetched.
WHERE = (("recordings", "replay"), ("fleet", "fleet|many"), ("full", "^(?!.*(replay|fleet|many|login))"))
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


def check(browser: Browser, server: CannedServer, state: str, losses: Iterator[tuple[str, str]]) -> None:
    """Open a page for each loss, and press its STOP."""
    server.show(STATES[state])
    for name, fault in losses:
        before = len(server.sent("estop")) + len(server.posted)
        kind = "text/css" if name.endswith(".css") else "text/javascript"
        lost = {re.compile(f"/static/.*/{re.escape(name)}"): FAULTS[fault](server.static.files[name], kind)}
        with tab(browser, server.url + STATES[state].path, script=_SOON, here="commit", routes=lost) as opened:
            assert opened.until(_SHOWS, 20), (name, fault)
            assert fault != "lost once" or opened.until(_WHOLE, 20), name
            opened.page.wait_for_timeout(500)
            opened.page.evaluate(_PRESS)
            stopped = lambda before=before: len(server.sent("estop")) + len(server.posted) > before
            assert opened.until(stopped, 5), (name, fault)
            while _UNANSWERED:
                _UNANSWERED.pop().abort()
            opened.context.unroute_all(behavior="ignoreErrors")


@pytest.mark.timeout(300)
@pytest.mark.parametrize("state", SAMPLE)
def test_a_page_that_loses_a_file_stops_robots(browser: Browser, server: CannedServer, state: str) -> None:
    faults = itertools.cycle(FAULTS)
    check(browser, server, state, ((name, next(faults)) for name in SAMPLE[state] for _ in range(2)))


@pytest.mark.page
@pytest.mark.timeout(1800)
@pytest.mark.parametrize(("state", "pattern"), WHERE)
def test_a_page_that_loses_any_file_stops_robots(
    browser: Browser, server: CannedServer, state: str, pattern: str
) -> None:
    names = [name for name in server.static.files if re.search(pattern, name) and not name.endswith(".html")]
    check(browser, server, state, zip(names, itertools.cycle(FAULTS), strict=False))


def test_its_stop_is_a_form_that_the_server_takes(browser: Browser, served: Served, robot: RecordingRobot) -> None:
    lost = {"**/main.js": lambda route: route.abort(), "**/*.*/main.js": lambda route: route.abort()}
    with served.page() as other, tab(browser, served.origin, script=_SOON, routes=lost) as opened:
        assert other.knows(robot.base)
        assert opened.until(_SHOWS)
        opened.page.get_by_role("button", name="STOP ALL").click()
        assert opened.until(lambda: robot.latched)
        assert opened.until("document.body.innerText.includes('Confirmed by')")
        assert opened.violations == []
